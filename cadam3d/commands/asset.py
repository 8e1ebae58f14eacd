"""Asset: open the results of a run, and write files of them, for all commands that use a finished run."""

import os
import tempfile
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from jaxtyping import Float
from omegaconf import DictConfig
from torch import Tensor

from cadam3d.commands.messages import keeping_others, note_backend, note_omission
from cadam3d.core.cameras import Cameras
from cadam3d.core.checks import fail, require_choice
from cadam3d.core.device import resolve_device
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.outcome import Outcome
from cadam3d.core.render import RenderFn, RenderOutput
from cadam3d.exporter.base import Exporter
from cadam3d.io.asset_file import read_gaussians
from cadam3d.io.frames import UPS
from cadam3d.io.records import read_summary
from cadam3d.io.run_folder import (
    ASSET,
    CONFIG,
    expanded,
    has_file,
    nearest_existing,
    numbered,
    remove_empty,
    require_writable,
    shown,
    spare,
    suggestion,
    typed_path,
)
from cadam3d.rasterizer.base import Rasterizer, render_fn
from cadam3d.settings.compose import component, components
from cadam3d.settings.line import EXPORTERS, resume_word, setting_word, suffix_of
from cadam3d.settings.trust import read_components, require_contained, search_folders
from cadam3d.sweep.folder import is_sweep

LONGEST_NAME = 60  # characters of a name in a suggestion


@dataclass(frozen=True)
class Asset:
    """Gaussians from a file of any format, on the requested device."""

    gaussians: Gaussians
    ply: Path  # the file, which is called so even if it has another format
    folder: Path  # of the run, or named after a single file


@dataclass(frozen=True)
class Output:
    """A file that an exporter has written."""

    path: Path
    exporter: str  # its name, such as "ply"


# Writes files of an asset into a folder.
ExportFn = Callable[[DictConfig, Asset, Path], list[Output]]


def open_asset(cfg: DictConfig) -> Asset:
    """Return the asset that ``run=`` or ``ply=`` names; exactly one of them must be given."""
    require_one(cfg)
    if cfg.run is not None:
        return open_run(find_run(str(cfg.run)), cfg.device)
    ply = expanded(str(cfg.ply))
    gaussians = read_gaussians(ply, up=cfg.ply_up).to(resolve_device(cfg.device))
    return Asset(gaussians=gaussians, ply=ply, folder=ply.with_suffix(""))


def require_one(cfg: DictConfig) -> None:
    """Raise ``UserError`` unless exactly one of ``run=`` and ``ply=`` is given.

    The value of ``ply=`` must not be the folder of a run, and that of ``ply_up=`` must be an axis or null.
    """
    if (cfg.run is None) == (cfg.ply is None):
        got, line = ("neither", suggestion("", "run", ASSET)) if cfg.run is None else ("both", "ply=null")
        raise UserError(f"run, ply: expected one of them, got {got}. Try: {line}")
    if cfg.ply is not None and has_file(expanded(str(cfg.ply)), CONFIG):
        line = f"ply=null {setting_word('run', cfg.ply)}"
        raise UserError(f"ply: expected a file, got {str(cfg.ply)!r}, the folder of a run. Try: {line}")
    if cfg.ply_up is not None:
        require_choice("ply_up", cfg.ply_up, UPS)


def find_asset(folder: Path) -> Path:
    """Return the path of the asset of the run in ``folder``. Raises ``UserError`` if it has none yet."""
    ply = folder / ASSET
    if not has_file(ply):
        line = f"cadam3d train {resume_word(shown(folder))}"
        # A run that has finished without the file was asked for other formats, or for none.
        if read_summary(folder).get("outcome") == Outcome.FINISHED:
            line += " 'exporter=[ply]'"
        raise UserError(f"{shown(folder)}: has no {ASSET} yet. Try: {line}")
    return ply


def open_run(folder: Path, device: str) -> Asset:
    """Return the asset of the run in ``folder``."""
    ply = find_asset(folder)
    return Asset(gaussians=read_gaussians(ply).to(resolve_device(device)), ply=ply, folder=folder)


def find_run(text: str) -> Path:
    """Return the folder of the run that ``text`` names. Raises ``UserError`` if it does not hold a run."""
    folder = typed_path(text)
    if has_file(folder, CONFIG):
        return folder
    example = suggestion("", "run", CONFIG)
    if not os.path.lexists(folder):
        reason = "no such folder"
    elif has_file(folder):
        reason = "it is a file"
    elif is_sweep(folder):
        reason = "it is a sweep, which has many runs"
        started = [config.parent for config in sorted(folder.glob(f"*/{CONFIG}"))]
        example = setting_word("run", shown(started[0])) if started else example
    else:
        reason = f"it has no {CONFIG}"
    raise UserError(f"run: expected the folder of a run, got {text!r} ({reason}). Try: {example}")


def run_components(
    folder: Path, *names: str, is_trusted: bool, retry: str, optional: Collection[str] = ()
) -> DictConfig:
    """Return the prompt, the seed and the components ``names`` of the run in ``folder``.

    Those of ``optional`` may be missing. Raises ``UserError`` if they are not of this package or of
    ``--config-dir``, unless the run is trusted. ``retry`` is the line that trusts it.
    """
    return read_components(
        folder / CONFIG,
        names,
        search_folders(HydraConfig.get().runtime.config_sources),
        is_trusted=is_trusted,
        retry=retry,
        optional=optional,
    )


def renderer(rasterizer: DictConfig, gaussians: Gaussians) -> RenderFn:
    """Return a function that renders ``gaussians`` and prepares the configured rasterizer at first use."""
    built: Rasterizer = component(rasterizer, Rasterizer, "rasterizer")
    render = render_fn(built, lambda: gaussians)

    def render_with_note(
        cameras: Cameras, background: Float[Tensor, "v 3"], shown: Gaussians | None = None
    ) -> RenderOutput:
        note_backend(built.prepare(gaussians.device))
        return render(cameras, background, shown)

    return render_with_note


def export_all(cfg: DictConfig, asset: Asset, folder: Path) -> list[Output]:
    """Run every exporter of ``cfg`` on ``asset``, and return the files that they have written in ``folder``.

    An exporter that fails costs only its own files. Raises ``UserError`` if all of them fail.
    """
    render = renderer(cfg.rasterizer, asset.gaussians)

    def write(name: str, exporter: Exporter) -> list[Path]:
        paths = exporter.export(asset.gaussians, render, folder)
        note_omission(f"exporter.{name}", exporter.omission(asset.gaussians))
        return paths

    return run_exporters(cfg, write)


def run_exporters(cfg: DictConfig, write: Callable[[str, Exporter], list[Path]]) -> list[Output]:
    """Call ``write`` with the name and every exporter of ``cfg``, and return the files that it has written.

    An exporter that fails costs only its own files. Raises ``UserError`` if all of them fail.
    """
    exporters: Mapping[str, Exporter] = components(cfg.exporter, Exporter, "exporter")
    if not exporters:
        raise UserError("exporter: expected at least one, got none. Try: 'exporter=[ply]'")
    outputs, warnings = [], []
    for name, exporter in exporters.items():
        with keeping_others(f"exporter.{name}", warnings, is_only=len(exporters) == 1):
            outputs += [Output(path, name) for path in write(name, exporter)]
    if len(warnings) == len(exporters):
        raise UserError(warnings[0])
    return outputs


def write_files(
    cfg: DictConfig,
    asset: Asset,
    name: str,
    into_folder: ExportFn = export_all,
    into_file: ExportFn = export_all,
) -> list[Output]:
    """Run the exporters of ``cfg`` on ``asset``, and return the files that they have written.

    ``output=`` names a file if it has a suffix, does not end with a slash, and is not a folder that exists.
    Then ``into_file`` writes it into a temporary folder, from which it is moved. Otherwise it names a folder,
    by default ``name`` beside the asset, into which ``into_folder`` writes.
    """
    if cfg.output is None and asset.folder.is_dir():
        require_contained(asset.folder, f"output={spare(name)}")
    text = str(asset.folder / name if cfg.output is None else cfg.output)
    target = expanded(text)
    if not text.strip() or typed_path(text).parent == typed_path(text):
        raise fail("output", expected="a file or a folder", got=text, example=f"output={name}")
    try:
        if cfg.output is not None and target.suffix and not text.endswith("/") and not target.is_dir():
            return [_one_file(cfg, asset, target, into_file)]
        if os.path.lexists(target) and not target.is_dir():
            line = setting_word("output", numbered(target.with_name(target.stem), first=1))
            raise UserError(f"output: expected a folder, got {text!r}, which is a file. Try: {line}")
        existing = nearest_existing(target)
        target.mkdir(parents=True, exist_ok=True)
        require_writable(target)
    except OSError as error:
        place = nearest_existing(target.parent)
        reason = f"{shown(place)} is a file" if has_file(place) else error.strerror or error
        # A long name loses its suffix here, and an unknown suffix would be refused: both become folders.
        suffix = suffix_of(target.name)
        is_file = suffix in EXPORTERS and len(target.name) <= LONGEST_NAME
        free = spare(target.name, suffix=target.name[-len(suffix) :]) if is_file else None
        line = setting_word("output", free or spare(target.stem[:LONGEST_NAME] or name))
        raise UserError(f"output: cannot write to {target} ({reason}). Try: {line}") from error
    try:
        return into_folder(cfg, asset, target)
    finally:
        remove_empty(target, existing)


def _one_file(cfg: DictConfig, asset: Asset, target: Path, export: ExportFn) -> Output:
    """Export into a folder beside ``target``, then move the file to its final name in a single step.

    Raises ``OSError`` if ``target`` cannot be written.
    """
    existing = nearest_existing(target.parent)
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        with tempfile.TemporaryDirectory(dir=target.parent, prefix=".export-") as folder:
            outputs = export(cfg, asset, Path(folder))
            suffixes = {suffix_of(output.path.name) for output in outputs}
            if len(outputs) != 1 or suffixes != {suffix_of(target.name)}:
                suffix = suffix_of(target.name)
                stem = target.name[: -len(suffix)]
                line = setting_word("output", f"{numbered(target.with_name(stem), first=1)}/")
                if suffix not in EXPORTERS:
                    expected = f"a file with suffix {'|'.join(EXPORTERS)}, or a folder"
                    raise UserError(f"output: expected {expected}, got {str(target)!r}. Try: {line}")
                raise UserError(
                    f"output: expected the name of a folder, got {str(target)!r}, because "
                    f"exporter=[{','.join(cfg.exporter)}] writes {len(outputs)} file(s) with suffix "
                    f"{'|'.join(sorted(suffixes))}. Try: {line}"
                )
            return Output(outputs[0].path.replace(target), outputs[0].exporter)
    finally:
        remove_empty(target.parent, existing)
