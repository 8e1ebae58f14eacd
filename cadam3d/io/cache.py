"""Cache: the user's folder for files that are expensive but can be made again."""

import os
from pathlib import Path

# The environment variable with the folder that the jobs of a sweep share.
TRACES = "CADAM3D_TRACES"


def default_cache_dir() -> Path:
    """Return ``cadam3d`` in the user's cache folder (``$XDG_CACHE_HOME``, else ``~/.cache``)."""
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path("~/.cache").expanduser()) / "cadam3d"
