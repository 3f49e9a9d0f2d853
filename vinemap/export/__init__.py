"""Rows, lanes and canopies in the formats of tractors, robots and other programs."""

GUIDANCE = ("agopengps", "geojson", "isoxml", "nav2", "opennav_coverage", "shapefile")
"""Formats of lines."""
MESHES = ("gazebo", "obj", "ply")
"""Formats of canopies."""
FORMATS = (*GUIDANCE, *MESHES)
LINES = ("lanes", "rows", "both")
