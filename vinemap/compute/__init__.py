"""Work on all cores: compiled loops and their cache, threads, parts that hang together, the machine, watched processes.

Nothing here knows of vineyards.
"""
