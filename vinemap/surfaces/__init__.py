"""What the heights of a cloud tell, as rasters: terrain, canopy height, canopy cover. The chain begins here."""
