"""``make bench``: seconds and memory of the chain, beside reading, promises and other tools."""
