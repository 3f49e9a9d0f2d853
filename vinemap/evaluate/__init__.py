"""How good a map of rows is: against reference lines (Table 2.2), another survey, and what stands there in no row.

Table 3.1's indices of canopies need no truth: they are among the numbers of sections (`canopy/numbers.py`).
"""
