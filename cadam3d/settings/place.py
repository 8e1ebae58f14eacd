"""Place: make a folder the place of one run, and leave it as it was if the run is refused."""

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from cadam3d.core.errors import UserError
from cadam3d.io.lock import locked
from cadam3d.io.reading import LARGEST_YAML, read_bytes
from cadam3d.io.run_folder import (
    CONSOLE,
    HYDRA,
    LOCK,
    OVERRIDES,
    claim,
    copying,
    nearest_existing,
    numbered,
    occupant,
    remove_empty,
    require_writable,
    shown,
    spare,
)
from cadam3d.settings.line import RUN_FOLDER, resume_word, setting_word


@dataclass(frozen=True)
class Snapshot:
    """The folder of a run before anything is written into it."""

    folder: Path
    # Apart from what Hydra writes before a run begins: names, inodes, sizes and times of change.
    entries: dict[str, tuple[int, ...]]
    has_settings: bool  # whether Hydra's folder exists
    settings: dict[Path, bytes]  # the files in it
    logs: dict[Path, int]  # bytes

    @classmethod
    def of(cls, folder: Path) -> "Snapshot":
        """Return the present state of ``folder``. Raises ``UserError`` if Hydra's files cannot be read."""
        settings = (folder / HYDRA).glob("*.yaml")
        return cls(
            folder=folder,
            entries=_entries(folder),
            has_settings=(folder / HYDRA).is_dir(),
            settings={path: read_bytes(path, largest=LARGEST_YAML) for path in settings},
            logs={path: path.stat().st_size for path in folder.glob("*.log")},
        )

    def has_begun(self) -> bool:
        """Return whether a run has written anything of its own, which starts with its configuration."""
        try:
            return _entries(self.folder) != self.entries
        except OSError:  # the folder is gone or cannot be read any more
            return True

    def restore(self) -> None:
        """Undo what Hydra writes before a run begins. What cannot be undone stays."""
        for path in (self.folder / HYDRA).glob("*.yaml"):
            with suppress(OSError):
                if path not in self.settings:
                    path.unlink()
                elif path.read_bytes() != self.settings[path]:
                    path.write_bytes(self.settings[path])
        if not self.has_settings:
            with suppress(OSError):
                (self.folder / HYDRA).rmdir()
        for path in self.folder.glob("*.log"):
            with suppress(OSError):
                if path in self.logs:
                    os.truncate(path, self.logs[path])
                else:
                    path.unlink()


@contextmanager
def occupied(wanted: Path, *, is_chosen: bool, resume: Path | None) -> Iterator[Path]:
    """Lock the folder of a run while the block trains in it, and yield that folder.

    ``resume`` is the run that the line continues, or a checkpoint in it. A fresh run gets the folder
    ``wanted`` if the user has chosen it, else a new one. If the block raises before the run has begun, the
    folder is left as it was. Raises ``UserError`` if another process trains in the folder, if a fresh run
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
        snapshot = None
        try:
            if resume is None:
                _refuse_occupied(folder)
            snapshot = Snapshot.of(folder)
            yield folder
        except BaseException as error:
            if snapshot is not None and snapshot.has_begun():
                raise
            if snapshot is not None:
                snapshot.restore()
            if not has_lock_file:
                with suppress(OSError):
                    (folder / LOCK).unlink()
            remove_empty(folder, existing)
            if problem := _problem_of(error, folder):
                raise _not_writable(folder, resume, problem) from error
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


def _problem_of(error: BaseException, folder: Path) -> OSError | None:
    """Return why Hydra could not write into ``folder``; None for any other exception.

    Python's logging raises ``ValueError`` if it cannot open its file, from the exception with the reason.
    """
    cause = error.__cause__ if isinstance(error, ValueError) else error
    if not isinstance(cause, OSError) or cause.errno is None:
        return None
    if cause.filename is not None and not Path(os.fsdecode(cause.filename)).is_relative_to(folder.absolute()):
        return None
    return cause


def _entries(folder: Path) -> dict[str, tuple[int, ...]]:
    """Return what is in ``folder`` apart from the files that exist before a run begins."""
    seen = {}
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name not in (HYDRA, LOCK, CONSOLE) and not entry.name.endswith(".log"):
                facts = entry.stat(follow_symlinks=False)
                seen[entry.name] = (facts.st_ino, facts.st_size, facts.st_mtime_ns)
    return seen
