"""The command line as ``python -m vinemap``."""

from vinemap.cli.main import main

main()
