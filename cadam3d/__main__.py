"""Run the command line: ``python -m cadam3d`` does the same as ``cadam3d``."""

import sys


def main() -> None:
    """Run ``cadam3d`` without the modules of the current folder, which Python puts first with ``-m``."""
    current = None if sys.flags.safe_path else sys.path.pop(0)
    from pathlib import Path

    # A checkout that is not installed is found in the current folder only.
    if current is not None and Path(current) == Path(__file__).parents[1]:
        sys.path.insert(0, current)
    from cadam3d import cli

    cli.main()


if __name__ == "__main__":
    main()
