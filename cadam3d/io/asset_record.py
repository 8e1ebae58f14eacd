"""asset.json: describes the files that ``cadam3d export`` has written, for those who receive the folder.

The file is a JSON object with these entries, in this order. An entry whose value is not known is null.

- ``schema``: 1, the version of this layout.
- ``source``: the file that was read: its ``name``, ``sha256``, ``gaussians`` and ``sh_degree``.
- ``prompt``, ``seed``, ``steps``, ``densifier``, ``objective`` and ``prior``: how the run made the asset,
  as far as its ``summary.json`` or ``config.yaml`` state it. All are null for a file that is not in a run.
- ``trained_with`` and ``exported_with``: versions of ``cadam3d`` and ``torch``.
- ``files``: one object for each file, sorted by name: ``name``, ``format`` (the exporter), ``bytes``,
  ``sha256``, ``frame`` (``up`` and ``front``, the axes of the file to which the top and the front of the
  object point, and ``handedness``; null for a page), ``sh_degree``, ``gaussians`` and ``triangles``.

A record describes one asset. Exporting the same asset again keeps the entries of files that have not changed
since; an entry of another asset is dropped.
"""

import hashlib
import shlex
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from cadam3d.core.errors import UserError
from cadam3d.io.frames import AXES, UPS
from cadam3d.io.jsonl import is_whole, read_json, write_json
from cadam3d.io.reading import opened
from cadam3d.io.records import read_config, read_summary
from cadam3d.io.run_folder import ASSET_RECORD, CONFIG, numbered, shown

SCHEMA = 1
LONGEST_TEXT = 10_000  # characters of a prompt
LONGEST_NAME = 255  # bytes of a file name
LONGEST_WORD = 100  # characters of a format or a hash
MOST_FILES = 1000
CHUNK_BYTES = 1 << 20
# Entries of the record, and the names under which a summary has them.
FACTS = {
    **{name: name for name in ("prompt", "seed", "steps", "densifier")},
    "objective": "guidance",
    "prior": "prior",
}
VERSIONS = ("cadam3d", "torch")


@dataclass(frozen=True, kw_only=True)
class Frame:
    """The axes of a file."""

    up: str  # one of UPS
    front: str  # to which the front of the object points
    handedness: str = "right"

    @classmethod
    def of(cls, up: str) -> "Frame":
        """Return the axes of a file with the up axis ``up`` (see ``frames.py``)."""
        # The front of the object is the +x axis of the world: the first column of the matrix.
        [axis] = [number for number, row in enumerate(AXES[up]) if row[0]]
        return cls(up=up, front=("+" if AXES[up][axis][0] > 0 else "-") + "xyz"[axis])


@dataclass(frozen=True, kw_only=True)
class FileEntry:
    """One file, as asset.json describes it."""

    name: str
    format: str
    bytes: int
    sha256: str
    frame: Frame | None
    sh_degree: int | None
    gaussians: int | None
    triangles: int | None


@dataclass(frozen=True, kw_only=True)
class Source:
    """The asset that was exported."""

    name: str
    sha256: str
    gaussians: int
    sh_degree: int
    run: Path | None  # the folder of its run


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal. Raises ``UserError`` if it cannot be read."""
    digest = hashlib.sha256()
    with opened(path) as file:
        while chunk := file.read(CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest()


def require_own_record(folder: Path) -> None:
    """Raise ``UserError`` if ``folder`` has an asset.json that is not ours, which would be overwritten."""
    path = folder / ASSET_RECORD
    if (path.exists() or path.is_symlink()) and _read(path) is None:
        raise UserError(
            f"output: {shown(folder)} holds an {ASSET_RECORD} that cadam3d export has not written. "
            f"Try: {shlex.quote(f'output={shown(numbered(folder))}')}"
        )


def write_record(
    folder: Path, source: Source, entries: Sequence[FileEntry], *, exported_with: Mapping[str, str]
) -> Path:
    """Write asset.json with ``entries`` and those of earlier exports of ``source``, and return its path.

    Raises ``UserError`` if a file cannot be read or written.
    """
    path = folder / ASSET_RECORD
    read = {name: getattr(source, name) for name in ("name", "sha256", "gaussians", "sh_degree")}
    files = {entry.name: asdict(entry) for entry in entries}
    before = _read(path) or {}
    if before.get("source", {}).get("sha256") == read["sha256"]:
        files |= {
            entry["name"]: entry
            for entry in before["files"]
            if entry["name"] not in files and _is_unchanged(folder / entry["name"], entry)
        }
    record = {
        "schema": SCHEMA,
        "source": read,
        **facts_of(source.run),
        "exported_with": dict(exported_with),
        "files": [files[name] for name in sorted(files)],
    }
    write_json(path, record)
    return path


def facts_of(run: Path | None) -> dict[str, Any]:
    """Return what a run states about its training. A stranger may have written it, so values are checked."""
    summary = read_summary(run) if run is not None else {}
    facts: dict[str, Any] = {name: _plain(summary.get(key)) for name, key in FACTS.items()}
    # A run that still trains has no summary. Its configuration names classes, not options.
    if run is not None and None in (facts["prompt"], facts["seed"]):
        with suppress(UserError):
            config = read_config(run / CONFIG)
            for name in ("prompt", "seed"):
                if facts[name] is None:
                    facts[name] = _plain(config.get(name))
    return facts | {"trained_with": {name: _plain(summary.get(name)) for name in VERSIONS}}


def _plain(value: object) -> str | int | None:
    """Return a value of a run if it is a text, which is cut, or a whole number; None for anything else."""
    if isinstance(value, str):
        # YAML can spell half of a character pair, which no file can hold.
        return value[:LONGEST_TEXT].encode("utf-8", "replace").decode("utf-8")
    return value if is_whole(value) else None


def _read(path: Path) -> dict[str, Any] | None:
    """Return an earlier record with its valid entries; None if the file is not a record."""
    try:
        record = read_json(path)
    except UserError:
        return None
    if not isinstance(record, dict) or record.get("schema") != SCHEMA:
        return None
    source, files = record.get("source"), record.get("files")
    if not isinstance(source, dict) or not isinstance(files, list):
        return None
    return {"source": source, "files": [entry for entry in files[:MOST_FILES] if _is_entry(entry)]}


def _is_entry(entry: Any) -> bool:
    """Return whether an entry of a record is one that this module could have written."""
    names = FileEntry.__dataclass_fields__
    if not isinstance(entry, dict) or entry.keys() != names.keys():
        return False
    name, frame, words = entry["name"], entry["frame"], (entry["format"], entry["sha256"])
    counts = [entry[key] for key in ("sh_degree", "gaussians", "triangles")]
    return (
        isinstance(name, str)
        and all(isinstance(word, str) and len(word) <= LONGEST_WORD for word in words)
        and is_whole(entry["bytes"])
        and all(count is None or is_whole(count) for count in counts)
        and (frame is None or any(frame == asdict(Frame.of(up)) for up in UPS))
        and name.isprintable()
        and len(name.encode()) <= LONGEST_NAME
        and name not in (".", "..")
        and not set(name) & set("/\\")
    )


def _is_unchanged(path: Path, entry: Mapping[str, Any]) -> bool:
    """Return whether ``path`` is still the file that an entry describes."""
    try:
        is_same_size = not path.is_symlink() and path.stat().st_size == entry["bytes"]
        return is_same_size and sha256_of(path) == entry["sha256"]
    except (OSError, UserError):
        return False
