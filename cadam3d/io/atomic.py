"""Atomic writes: a file is written under another name and then renamed, so it appears whole or not at all."""

import os
import shutil
from collections.abc import Callable, Iterator
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
        # Find out now whether the folder can be written: ffmpeg would only report a broken pipe. A link with
        # this name would lead to another file.
        temporary.unlink(missing_ok=True)
        temporary.touch(exist_ok=False)
        yield temporary
        # After a power cut, the new name must not point to an empty file, so the contents are written first.
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        raise _unwritable(path, error) from error
    finally:
        # An earlier error is more important than one of the clean-up.
        with suppress(OSError):
            temporary.unlink()


@contextmanager
def replacing_series(folder: Path, is_member: Callable[[str], bool]) -> Iterator[Path]:
    """Yield a temporary folder for a new series of files, which replaces an old series in ``folder``.

    ``is_member`` returns whether a name belongs to the series; other files in ``folder`` stay. If the block
    raises, the old series stays. A kill may leave a part of one series, but never a mixture of both. Raises
    ``UserError`` if ``folder`` cannot be written.
    """
    temporary = folder.with_name(f"{TEMPORARY}{os.getpid()}-{folder.name}")
    try:
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir(parents=True)
        yield temporary
        folder.mkdir(exist_ok=True)
        for old in folder.iterdir():
            if is_member(old.name) and not old.is_dir():
                old.unlink()
        for new in sorted(temporary.iterdir()):
            new.replace(folder / new.name)
    except OSError as error:
        raise _unwritable(folder, error) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def remove_leftovers(folder: Path) -> None:
    """Delete what a killed process has half written in ``folder``, which must have a single writer."""
    for leftover in folder.glob(f"{TEMPORARY}*"):
        if leftover.is_dir() and not leftover.is_symlink():
            shutil.rmtree(leftover, ignore_errors=True)
        else:
            leftover.unlink(missing_ok=True)


def _unwritable(path: Path, error: OSError) -> UserError:
    reason = error.strerror or error
    return UserError(f"{path}: cannot be written ({reason}). Try: another place, or df -h to see its space")
