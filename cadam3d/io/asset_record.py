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

import torch

from cadam3d import __version__
from cadam3d.core.errors import UserError
from cadam3d.io.frames import AXES
from cadam3d.io.jsonl import Whole, fits, read_json, write_json
from cadam3d.io.reading import opened
from cadam3d.io.records import read_config, read_summary
from cadam3d.io.run_folder import ASSET_RECORD, CONFIG, numbered, shown

SCHEMA = 1
CHUNK_BYTES = 1 << 20
# Entries of the record, and the names under which a summary has them.
FACTS = {
    **{name: name for name in ("prompt", "seed", "steps", "densifier")},
    "objective": "guidance",
    "prior": "prior",
}
VERSIONS = ("cadam3d", "torch")


@dataclass(frozen=True, kw_only=True)
class FileEntry:
    """One file, as asset.json describes it."""

    name: str
    format: str
    bytes: int
    sha256: str
    frame: Mapping[str, str] | None  # of :func:`axes_of`
    sh_degree: int | None
    gaussians: int | None
    triangles: int | None


def axes_of(up: str) -> dict[str, str]:
    """Return the axes of a file with the up axis ``up`` (see ``frames.py``), as asset.json has them."""
    # The front of the object is the +x axis of the world: the first column of the matrix.
    [axis] = [number for number, row in enumerate(AXES[up]) if row[0]]
    front = ("+" if AXES[up][axis][0] > 0 else "-") + "xyz"[axis]
    return {"up": up, "front": front, "handedness": "right"}


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
    folder: Path, source: Mapping[str, Any], entries: Sequence[FileEntry], *, run: Path | None
) -> Path:
    """Write asset.json with ``entries`` and earlier exports of ``source``, and return its path.

    ``source`` is that entry of the record, and ``run`` the folder of the run that made the asset. Raises
    ``UserError`` if a file cannot be read or written.
    """
    path = folder / ASSET_RECORD
    files = {entry.name: asdict(entry) for entry in entries}
    before = _read(path)
    if before is not None and before["source"].get("sha256") == source["sha256"]:
        for entry in before["files"]:
            # Entries of another form, and of files that have changed, are left out.
            with suppress(UserError, TypeError, KeyError):
                if sha256_of(folder / Path(entry["name"]).name) == FileEntry(**entry).sha256:
                    files.setdefault(entry["name"], entry)
    record = {
        "schema": SCHEMA,
        "source": dict(source),
        **facts_of(run),
        "exported_with": {"cadam3d": __version__, "torch": torch.__version__},
        "files": [files[name] for name in sorted(files)],
    }
    write_json(path, record)
    return path


def facts_of(run: Path | None) -> dict[str, Any]:
    """Return what a run states about its training. A stranger may have written it, so values are checked."""
    summary = read_summary(run) if run is not None else {}
    stated = {name: summary.get(key) for name, key in FACTS.items()}
    # A run that still trains has no summary. Its configuration names classes, not options.
    if run is not None and not summary:
        with suppress(UserError):
            config = read_config(run / CONFIG)
            stated |= {name: config.get(name) for name in ("prompt", "seed")}
    versions = {name: _plain(summary.get(name)) for name in VERSIONS}
    return {name: _plain(value) for name, value in stated.items()} | {"trained_with": versions}


def _plain(value: Any) -> str | int | None:
    """Return a value of a run if it is a text or a whole number; None for anything else."""
    return value if fits(value, str | Whole) else None


def _read(path: Path) -> dict[str, Any] | None:
    """Return an earlier record; None if the file is not one."""
    try:
        record = read_json(path)
    except UserError:
        return None
    if not isinstance(record, dict) or record.get("schema") != SCHEMA:
        return None
    is_record = isinstance(record.get("source"), dict) and isinstance(record.get("files"), list)
    return record if is_record else None
