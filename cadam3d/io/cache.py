"""Where what is dear to make and can be made again is kept, outside of runs."""

import os
from pathlib import Path

TRACES = "CADAM3D_TRACES"  # the variable that names a folder for what the jobs of a sweep share


def default_cache_dir() -> Path:
    """``cadam3d`` in the user's cache folder (``$XDG_CACHE_HOME``, else ``~/.cache``)."""
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path("~/.cache").expanduser()) / "cadam3d"
