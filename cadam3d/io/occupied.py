"""Occupied: make a folder the place of one run, and leave it as it was if the run is refused."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from cadam3d.core.errors import UserError
from cadam3d.io.lock import locked
from cadam3d.io.run_folder import (
    LOCK,
    OVERRIDES,
    RUN_FOLDER,
    claim,
    copying,
    nearest_existing,
    numbered,
    occupant,
    remove_empty,
    require_writable,
    resume_word,
    setting_word,
    shown,
    spare,
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
    folder = wanted if resume is not None else claim(wanted, RUN_FOLDER, is_chosen=is_chosen)
    has_lock_file = (folder / LOCK).exists()
    with ExitStack() as stack:
        try:
            if resume is not None:
                require_writable(folder)
            stack.enter_context(
                locked(folder / LOCK, lambda holder: in_use(folder, holder, RUN_FOLDER, resume))
            )
        except OSError as error:
            raise _not_writable(folder, resume, error) from error
        before = set(folder.iterdir())
        try:
            if resume is None:
                _refuse_occupied(folder)
            yield folder
        except BaseException as error:
            has_begun = set(folder.iterdir()) != before
            if not has_begun and not has_lock_file:
                with suppress(OSError):
                    (folder / LOCK).unlink()
            remove_empty(folder, existing)
            is_here = isinstance(error, OSError) and str(error.filename).startswith(str(folder))
            if is_here and not has_begun:
                raise _not_writable(folder, resume, error) from error
            raise


def in_use(folder: Path, holder: str, key: str, resume: Path | None = None) -> UserError:
    """Return the error for a folder in which another process, described by ``holder``, writes."""
    if resume is None:
        return UserError(
            f"{key}: {shown(folder)} is in use by {holder}. Try: {setting_word(key, shown(numbered(folder)))}"
        )
    return UserError(f"resume: {shown(folder)} is in use by {holder}. Try: {_resume_copy(folder, resume)}")


def _refuse_occupied(folder: Path) -> None:
    """Refuse a fresh run in a folder with a run, or with anything else that it would overwrite."""
    name = occupant(folder)
    if name is None:
        return
    if (folder / OVERRIDES).is_file():
        raise UserError(
            f"{RUN_FOLDER}: {shown(folder)} holds a run already ({name}). "
            f"Try: cadam3d train {resume_word(shown(folder))}"
        )
    raise UserError(
        f"{RUN_FOLDER}: {shown(folder)} holds {name}, which a run would overwrite. "
        f"Try: {setting_word(RUN_FOLDER, shown(numbered(folder)))}"
    )


def _not_writable(folder: Path, resume: Path | None, error: OSError) -> UserError:
    reason = error.strerror or str(error)
    if resume is None:
        line = setting_word(RUN_FOLDER, spare("cadam3d"))
        return UserError(f"{RUN_FOLDER}: cannot write to {shown(folder)} ({reason}). Try: {line}")
    return UserError(
        f"resume: cannot write to {shown(folder)} ({reason}). Try: {_resume_copy(folder, resume)}"
    )


def _resume_copy(folder: Path, resume: Path) -> str:
    """Return a line for the shell that continues a copy of the run in ``folder``."""
    line, copy = copying(folder)
    place = copy / resume.relative_to(folder) if resume.is_relative_to(folder) else copy
    return f"{line} && cadam3d train {resume_word(place)}"
