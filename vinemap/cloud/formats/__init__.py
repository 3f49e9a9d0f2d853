"""Clouds other than LAS, LAZ and COPC on this machine's disk: a format a file, chosen in `chunks.py`.

Each gives :class:`vinemap.cloud.formats.told.Points`: what the file tells of them, and coordinates chunk by chunk.
"""
