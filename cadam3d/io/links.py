"""Links: a name that leads to a folder beside it, such as the newest run's folder.

Windows lets few users make links, and some disks have none. There, the name is a small file that says where
it leads, which commands follow as they follow a link.
"""

import logging
import os
from pathlib import Path

from cadam3d.core.console import say

# How a file begins that stands for a link. A path follows.
STAND_IN = "cadam3d reads this file as a link to the folder "
LONGEST = 4096  # bytes of such a file


def link(name: Path, folder: Path) -> None:
    """Make ``name`` a link to ``folder``. If that is not possible, print a note."""
    try:
        point(name, folder)
    except OSError as error:
        say(f"Note: {name} not updated ({error.strerror}).", logging.WARNING)


def point(name: Path, folder: Path) -> None:
    """Make ``name`` a link to ``folder``, in one step (two on Windows), also if it leads to another place.

    The link is relative if ``folder`` is beside it or deeper, so that both can be moved together. Raises
    ``OSError``, and ``FileExistsError`` if ``name`` is something else.
    """
    name.parent.mkdir(parents=True, exist_ok=True)
    target, base = folder.resolve(), name.parent.resolve()
    if os.path.lexists(name) and not name.is_symlink() and followed(name) == name:
        raise FileExistsError(0, "it exists and is not a link")
    place = target.relative_to(base) if target.is_relative_to(base) else target
    fresh = name.with_name(f".{name.name}-{os.getpid()}")
    fresh.unlink(missing_ok=True)
    try:
        fresh.symlink_to(place)
    except OSError:
        fresh.write_text(f"{STAND_IN}{place}\n", encoding="utf-8")
    try:
        if os.name == "nt":  # which replaces no link to a folder
            name.unlink(missing_ok=True)
        fresh.replace(name)
    finally:
        fresh.unlink(missing_ok=True)


def followed(path: Path) -> Path:
    """Return where ``path`` leads if it is a file that stands for a link, or is below one."""
    for place in (path, *path.parents):
        if place.is_file():
            with place.open("rb") as file:
                text = file.read(LONGEST).decode("utf-8", "replace")
            if text.startswith(STAND_IN):
                return place.parent / text.removeprefix(STAND_IN).strip() / path.relative_to(place)
    return path
