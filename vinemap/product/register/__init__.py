"""The register of an estate: which rows stand in it, under which numbers and names, and since when."""
