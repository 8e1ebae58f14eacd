"""How commands tell the user what is worth knowing and no error."""

import sys
from functools import cache

from cadam3d.rasterizer.base import Backend


@cache
def note(text: str) -> None:
    """Print ``text`` as a note, once per process."""
    print(f"Note: {text}", file=sys.stderr)


def note_backend(backend: Backend) -> None:
    """Say so where something slow renders in place of something faster."""
    if backend.reason:
        note(f"rendering with rasterizer={backend.name}, which is slow: {backend.reason}")
