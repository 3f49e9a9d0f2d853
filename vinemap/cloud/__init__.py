"""Point clouds: files read into metres of one CRS, clipped, in memory, in tiles or in pieces.

Another kind of cloud is read by a file of its own in `formats`.
"""
