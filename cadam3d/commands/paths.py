"""How commands write paths to the user."""

from pathlib import Path


def shown(path: Path) -> Path:
    """``path`` as a user in the current folder would write it."""
    path = path.resolve()
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
