"""Rows, lanes and canopies in the formats of tractors, robots and other programs."""

GUIDANCE = ("agopengps", "geojson", "isoxml", "nav2", "opennav_coverage", "shapefile")
"""Formats of lines."""
MESHES = ("gazebo", "obj", "ply")
"""Formats of canopies."""
TABLE = "table"
"""Numbers of rows and vines: one table of all products and their dates."""
FORMATS = (*GUIDANCE, *MESHES, TABLE)
LINES = ("lanes", "rows", "both")
