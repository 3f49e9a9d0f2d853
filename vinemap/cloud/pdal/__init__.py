"""PDAL as another engine, where it is installed: its readers, and its filters for ground.

`engine.py` tells whether it can be used, `reader.py` reads files with it and `ground.py` classifies ground. What calls
PDAL stands in `stages.py` alone, and runs in a process of its own: damaged files can end it.
"""
