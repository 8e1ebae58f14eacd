"""Comparing this checkout with another one, which several benchmarks do with the option ``--base``."""

import argparse
import os
from pathlib import Path

HERE = Path(__file__).resolve().parents[1]


def add_base(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--base`` to a command line."""
    parser.add_argument("--base", type=_checkout, metavar="FOLDER", help="a checkout to compare with")


def _checkout(text: str) -> Path:
    folder = Path(text).resolve()
    # Without this check, Python would import the installed package, and both columns would be the same.
    if not (folder / "cadam3d" / "__init__.py").is_file():
        message = f"expected a checkout of cadam3d, got {folder}. Try: git worktree add {folder} 994baea"
        raise argparse.ArgumentTypeError(message)
    return folder


def find_trees(base: Path | None) -> dict[str, Path]:
    """Return the checkouts to measure by name: ``base``, if there is one, and ``here``."""
    return {"here": HERE} if base is None else {"base": base, "here": HERE}


def environment_of(tree: Path) -> dict[str, str]:
    """Return the environment of a process that imports the package of a checkout."""
    return os.environ | {"PYTHONPATH": str(tree)}
