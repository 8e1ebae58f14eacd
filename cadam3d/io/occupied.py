"""Occupied: make a folder the place of one run, and leave it as it was if the run is refused."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from cadam3d.core.errors import UserError
from cadam3d.io.lock import locked
from cadam3d.io.run_folder import (
    LOCK,
    RUN_FOLDER,
    another_folder,
    claim,
    nearest_existing,
    not_writable,
    numbered,
    occupant,
    remove_empty,
    require_writable,
    shown,
)


@contextmanager
def occupied(wanted: Path, *, is_chosen: bool, resume: Path | None) -> Iterator[Path]:
    """Lock the folder of a run while the block trains in it, and yield that folder.

    ``resume`` is the run that the line continues, or a checkpoint in it. A fresh run gets the folder
    ``wanted`` if the user has chosen it, else a new one. If the block raises before it has written anything,
    a new folder is removed. Raises ``UserError`` if another process trains in the folder, if a fresh run
    would overwrite something in it, or if it cannot be written.
    """
    existing = nearest_existing(wanted if is_chosen else wanted.parent)
    folder = claim(wanted, RUN_FOLDER, is_chosen=is_chosen) if resume is None else wanted
    key = RUN_FOLDER if resume is None else "resume"
    has_lock_file = (folder / LOCK).exists()
    with ExitStack() as stack:
        try:
            require_writable(folder)
            stack.enter_context(locked(folder / LOCK, lambda holder: in_use(folder, holder, key)))
        except OSError as error:
            raise not_writable(key, folder, error) from error
        before = set(folder.iterdir())
        try:
            if resume is None and (name := occupant(folder)) is not None:
                raise UserError(
                    f"{key}: {shown(folder)} holds {name}, which a run would overwrite. "
                    f"Try: {another_folder(key, shown(numbered(folder)))}"
                )
            yield folder
        except BaseException as error:
            has_begun = set(folder.iterdir()) != before
            if not has_begun and not has_lock_file:
                with suppress(OSError):
                    (folder / LOCK).unlink()
            remove_empty(folder, existing)
            is_system = isinstance(error, OSError) and str(error.filename).startswith(str(folder))
            if isinstance(error, OSError) and is_system and not has_begun:
                raise not_writable(key, folder, error) from error
            raise


def in_use(folder: Path, holder: str, key: str) -> UserError:
    """Return the error for a folder in which another process, described by ``holder``, writes."""
    line = another_folder(key, shown(numbered(folder)))
    return UserError(f"{key}: {shown(folder)} is in use by {holder}. Try: {line}")
