"""Work on all cores: compiled loops and their cache, threads, parts that hang together, the machine, processes.

Locks between processes lie here as well. Nothing here knows of vineyards.
"""
