"""Files appear whole or not at all: written beside their place, then moved there in one step."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from cadam3d.core.checks import UserError

TEMPORARY = ".tmp-"  # in the name of every file that is still being written


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path in the same folder, with the same suffix; it becomes ``path`` if the block succeeds.

    If the block raises, the temporary file is removed and the old ``path``, if any, is left as it was. A
    full disk or a folder that cannot be written is a ``UserError``.
    """
    temporary = path.with_name(f"{TEMPORARY}{os.getpid()}-{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch()  # a folder that cannot be written says so here, not through a broken pipe of ffmpeg
        yield temporary
        # Contents before name: after a power cut the new name must not point to an empty file.
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        reason = error.strerror or str(error)
        raise UserError(
            f"{path}: cannot be written ({reason}). Try another place: hydra.run.dir=DIR, or free some space"
        ) from error
    finally:
        with suppress(OSError):  # nothing to remove, or no way to: the first error matters
            temporary.unlink()


def remove_leftovers(folder: Path) -> None:
    """Delete what a killed process left half-written in ``folder``; only where there is a single writer."""
    for leftover in folder.glob(f"{TEMPORARY}*"):
        leftover.unlink(missing_ok=True)
