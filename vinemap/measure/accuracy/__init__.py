"""``make accuracy``: rows and canopies of simulated vineyards against their truth."""
