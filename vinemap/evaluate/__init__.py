"""Rows judged: how sure, against references (Table 2.2) and another survey, what is in none, and vines one by one.

Table 3.1's indices of canopies need no truth: they are among the numbers of sections (`canopy/numbers.py`).
"""
