"""How good a map of rows is against reference lines (Table 2.2), and what has changed between two surveys."""
