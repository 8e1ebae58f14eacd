"""Linking: the names ``outputs/latest`` and ``best``, which lead to the folder of a run."""

import logging
import os
import shutil
from pathlib import Path

from cadam3d.core.console import say
from cadam3d.io.links import point
from cadam3d.io.run_folder import BEST, LATEST, LOCK, SUMMARY, has_file, numbered, shown


def link_latest(folder: Path) -> None:
    """Make ``outputs/latest`` a link to ``folder``. If that is not possible, print a note."""
    try:
        point(Path(LATEST), folder)
    except OSError as error:
        say(f"Note: {LATEST} not updated ({error.strerror}).", logging.WARNING)


def link_best(folder: Path, name: str) -> None:
    """Make ``best`` in ``folder`` a link to the run ``name`` beside it, or a copy if links are not possible.

    An earlier copy of another run is renamed and kept, because files may have been added to it. Raises
    ``OSError`` if neither is possible.
    """
    best, run = folder / BEST, folder / name
    try:
        point(best, run)
    except OSError:
        if has_file(best, SUMMARY) and (best / SUMMARY).read_bytes() == (run / SUMMARY).read_bytes():
            return
        if os.path.lexists(best):
            kept = numbered(best)
            best.rename(kept)
            say(f"Note: {shown(folder)}/{BEST} was renamed to {kept.name}.", logging.WARNING)
        # A copy that is interrupted must not be taken for a complete one.
        fresh = best.with_name(f".{BEST}-{os.getpid()}")
        try:
            shutil.copytree(run, fresh, ignore=shutil.ignore_patterns(LOCK))
            fresh.rename(best)
        finally:
            shutil.rmtree(fresh, ignore_errors=True)
