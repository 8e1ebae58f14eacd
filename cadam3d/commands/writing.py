"""Writing: run exporters on an asset, and put their files where ``output=`` says."""

import os
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from omegaconf import DictConfig

from cadam3d.build import components
from cadam3d.commands.messages import keeping_others, note
from cadam3d.commands.opened import OpenedAsset
from cadam3d.core.checks import fail
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.exporter.base import Exporter, suffix_in
from cadam3d.io.run_folder import (
    expanded,
    nearest_existing,
    not_writable,
    numbered,
    remove_empty,
    require_writable,
    setting_word,
    shown,
    spare,
    typed_path,
)
from cadam3d.settings.output import names_file
from cadam3d.settings.trust import require_contained


@dataclass(frozen=True)
class Output:
    """A file that an exporter has written."""

    path: Path
    name: str  # of the exporter, such as "ply"
    exporter: Exporter | None  # None for asset.json, which describes the others


# Writes files into a folder.
WriteFn = Callable[[Path], list[Output]]


def chosen_exporters(cfg: DictConfig) -> dict[str, Exporter]:
    """Return the exporters of a line by name. Raises ``UserError`` for none or wrong ones."""
    exporters: dict[str, Exporter] = components(cfg.exporter, Exporter, "exporter")
    if not exporters:
        raise UserError("exporter: expected at least one, got none. Try: 'exporter=[ply]'")
    return exporters


def run_exporters(
    exporters: Mapping[str, Exporter],
    gaussians: Gaussians,
    write: Callable[[Exporter], list[Path]],
    *,
    is_needed: bool = True,
) -> tuple[list[Output], list[str]]:
    """Call ``write`` with every exporter; return the files and a warning for each exporter that failed.

    An exporter that fails costs only its own files, and what a file cannot hold of ``gaussians`` is a note.
    Raises ``UserError`` if all exporters fail and ``is_needed``.
    """
    outputs: list[Output] = []
    warnings: list[str] = []
    for name, exporter in exporters.items():
        key = f"exporter.{name}"
        with keeping_others(key, warnings, is_only=is_needed and len(exporters) == 1):
            outputs += [Output(path, name, exporter) for path in write(exporter)]
            if omission := exporter.omission(gaussians):
                note(f"{key}: {omission}")
    if is_needed and len(warnings) == len(exporters):
        raise UserError(warnings[0])
    return outputs, warnings


def write_files(
    output: str | None, asset: OpenedAsset, name: str, into_folder: WriteFn, into_file: WriteFn
) -> list[Output]:
    """Write files of ``asset`` where ``output=`` says, and return them.

    ``output`` names a file if it has a suffix, does not end with a slash, and is not a folder that exists.
    Then ``into_file`` writes it into a temporary folder, from which it is moved. Otherwise it names a folder,
    by default ``name`` beside the asset, into which ``into_folder`` writes.
    """
    if output is None and asset.folder.is_dir():
        require_contained(asset.folder, f"output={spare(name)}")
    text = str(asset.folder / name if output is None else output)
    target = expanded(text)
    if not text.strip() or typed_path(text).parent == typed_path(text):
        raise fail("output", expected="a file or a folder", got=text, example=_free(Path(name)))
    try:
        if output is not None and names_file(text):
            return [_one_file(target, into_file)]
        if os.path.lexists(target) and not target.is_dir():
            raise fail("output", expected="a folder", got=text, example=_free(target))
        existing = nearest_existing(target)
        target.mkdir(parents=True, exist_ok=True)
        require_writable(target)
    except OSError as error:
        raise not_writable("output", target, error) from error
    try:
        return into_folder(target)
    finally:
        remove_empty(target, existing)


def _free(folder: Path) -> str:
    """Return the argument for a folder like ``folder`` that does not exist yet."""
    return setting_word("output", f"{shown(numbered(folder, first=1))}/")


def _one_file(target: Path, write: WriteFn) -> Output:
    """Write into a folder beside ``target``, then move the file to its final name in a single step.

    Raises ``OSError`` if ``target`` cannot be written.
    """
    existing = nearest_existing(target.parent)
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        with tempfile.TemporaryDirectory(dir=target.parent, prefix=".export-") as folder:
            outputs = write(Path(folder))
            suffixes = sorted({suffix_in(output.path.name) for output in outputs})
            if len(outputs) != 1 or not target.name.lower().endswith(suffixes[0]):
                expected = f"a folder, because {len(outputs)} file(s) with {'|'.join(suffixes)} are written"
                example = _free(target.with_name(target.name.partition(".")[0]))
                raise fail("output", expected=expected, got=str(target), example=example)
            return replace(outputs[0], path=outputs[0].path.replace(target))
    finally:
        remove_empty(target.parent, existing)
