"""Links: a name that leads to a folder beside it, such as the newest run's folder."""

import logging
import os
from pathlib import Path

from cadam3d.core.console import say


def link(name: Path, folder: Path) -> None:
    """Make ``name`` a link to ``folder``. If that is not possible, print a note."""
    try:
        point(name, folder)
    except OSError as error:
        say(f"Note: {name} not updated ({error.strerror}).", logging.WARNING)


def point(name: Path, folder: Path) -> None:
    """Make ``name`` a link to ``folder``, in one step, also if it is a link to another place.

    The link is relative if ``folder`` is beside it or deeper, so that both can be moved together. Raises
    ``OSError`` if the file system has no links, and ``FileExistsError`` if ``name`` is something else.
    """
    name.parent.mkdir(parents=True, exist_ok=True)
    target, base = folder.resolve(), name.parent.resolve()
    if os.path.lexists(name) and not name.is_symlink():
        raise FileExistsError(0, "it exists and is not a link")
    fresh = name.with_name(f".{name.name}-{os.getpid()}")
    fresh.unlink(missing_ok=True)
    fresh.symlink_to(target.relative_to(base) if target.is_relative_to(base) else target)
    try:
        fresh.replace(name)
    finally:
        fresh.unlink(missing_ok=True)
