"""``python -m cadam3d`` is ``cadam3d``."""

from cadam3d.cli import main

if __name__ == "__main__":
    main()
