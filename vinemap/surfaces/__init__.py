"""What the heights of a cloud tell, as rasters: terrain, canopy height, canopy cover; and which known lines it shows.

The chain begins here.
"""
