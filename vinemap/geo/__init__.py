"""Places: coordinate systems and the geoid, rasters, curves in plan, polygons and lines from people's files."""
