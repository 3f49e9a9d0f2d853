"""Vine rows (chapter 2 of the thesis), a phase of the chain a file.

Row field, key points, clusters, curves, and the fit with its ends and gaps; then blocks, numbers, confidence and
missing vines of the rows that were found. What several phases do in a row's own frame is in `frame.py` and
`centre_line.py`.
"""
