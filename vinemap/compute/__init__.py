"""Work on all cores: compiled loops and their cache, threads, what the machine has, processes that are watched.

Nothing here knows of vineyards.
"""
