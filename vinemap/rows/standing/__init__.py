"""Where rows stand: their canopies, ends and gaps, as seen and as known, and what of two rows is whose."""
