"""Vine rows (chapter 2 of the thesis), a phase of the chain a file.

Row field (from the waves of `surfaces/waves.py`), key points, clusters (of which `pieces/` are joined), curves, and the
fit to what stands there (`standing/`); then blocks, numbers and missing vines of the rows that were found. Points in a
row's own frame come from `cloud/frame.py`.
"""
