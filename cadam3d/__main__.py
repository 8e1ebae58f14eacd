"""Run the command line: ``python -m cadam3d`` does the same as ``cadam3d``."""

from cadam3d.cli import main

if __name__ == "__main__":
    main()
