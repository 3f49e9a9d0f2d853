"""Pieces of rows: torn at kinks where blocks abut, and joined end to end over missing vines, but not over tracks."""
