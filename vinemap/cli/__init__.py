"""The command line, a command a file; `terminal.py` shows progress and says errors in a line."""
