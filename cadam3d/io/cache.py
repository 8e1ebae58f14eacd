"""The one folder outside of runs that is written to: what is dear to make and can be made again."""

import os
from pathlib import Path


def default_cache_dir() -> Path:
    """``cadam3d`` in the user's cache folder (``$XDG_CACHE_HOME``, else ``~/.cache``)."""
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path("~/.cache").expanduser()) / "cadam3d"
