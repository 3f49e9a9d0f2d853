"""Canopies of rows (chapter 3 of the thesis), a step a file.

Sections, foliage and its feet, hulls, their peeling and growth, c-gons, numbers (Table 3.1 too) and meshes; `model.py`
puts them together. `classification.py` tells for every point of the cloud what it is. The data that flows between the
steps is in `points.py`.
"""
