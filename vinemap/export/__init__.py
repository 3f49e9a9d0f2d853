"""Rows and lanes in the formats of tractors, robots and other programs: one module a format."""

FORMATS = ("agopengps", "geojson", "isoxml", "nav2", "opennav_coverage", "shapefile")
LINES = ("lanes", "rows", "both")
