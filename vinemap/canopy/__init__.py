"""Canopies of rows (chapter 3 of the thesis), a step a file.

Sections, foliage and its feet, hulls and their peeling, c-gons, numbers, meshes; `model.py` puts them together. The
data that flows between them is in `points.py`.
"""
