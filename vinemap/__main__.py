"""The command line as ``python -m vinemap``."""

from vinemap.cli.main import main

if __name__ == "__main__":
    main()
