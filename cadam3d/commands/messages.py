"""Notes: messages that are neither results nor errors."""

import sys
from functools import cache

from cadam3d.rasterizer.base import Backend


@cache
def note(text: str) -> None:
    """Print ``text`` as a note, once per process."""
    print(f"Note: {text}", file=sys.stderr)


def note_backend(backend: Backend) -> None:
    """Print a note if a slow backend renders because a faster one is not available."""
    if backend.reason:
        note(f"rendering with rasterizer={backend.name}, which is slow: {backend.reason}")
