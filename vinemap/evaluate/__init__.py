"""How good a map of rows is against reference lines (Table 2.2), and what has changed between two surveys.

Table 3.1's indices of canopies need no truth: they are among the numbers of sections (`canopy/numbers.py`).
"""
