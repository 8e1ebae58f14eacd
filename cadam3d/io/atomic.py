"""Atomic writes: a file is written under another name and then renamed, so it appears whole or not at all."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from cadam3d.core.errors import UserError

TEMPORARY = ".tmp-"  # in the name of every file that is still being written


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the same folder, with the same suffix.

    If the block succeeds, the temporary file becomes ``path``. If the block raises, the temporary file is
    removed and an old ``path`` stays unchanged. Raises ``UserError`` if the disk is full or the folder cannot
    be written.
    """
    temporary = path.with_name(f"{TEMPORARY}{os.getpid()}-{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Find out now whether the folder can be written: ffmpeg would only report a broken pipe.
        temporary.touch()
        yield temporary
        # After a power cut, the new name must not point to an empty file, so the contents are written first.
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        reason = error.strerror or str(error)
        raise UserError(
            f"{path}: cannot be written ({reason}). Try another place: hydra.run.dir=DIR, or free some space"
        ) from error
    finally:
        # An earlier error is more important than one of the clean-up.
        with suppress(OSError):
            temporary.unlink()


def remove_leftovers(folder: Path) -> None:
    """Delete the half-written files of a killed process in ``folder``, which must have a single writer."""
    for leftover in folder.glob(f"{TEMPORARY}*"):
        leftover.unlink(missing_ok=True)
