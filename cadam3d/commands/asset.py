"""Asset: open the results of a run, as ``render``, ``export``, ``eval`` and ``view`` do first."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float
from omegaconf import DictConfig
from torch import Tensor

from cadam3d.commands.messages import note_backend
from cadam3d.core.cameras import Cameras
from cadam3d.core.device import resolve_device
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.render import RenderFn, RenderOutput
from cadam3d.exporter.base import Exporter
from cadam3d.io.ply import read_ply
from cadam3d.io.run_folder import ASSET, CONFIG, shown
from cadam3d.rasterizer.base import Rasterizer, render_fn
from cadam3d.settings.compose import component, components, load_config
from cadam3d.sweep.folder import is_sweep


@dataclass(frozen=True)
class Asset:
    """Gaussians from a file, on the requested device."""

    gaussians: Gaussians
    ply: Path
    folder: Path  # of the run, or named after a single file


def open_asset(cfg: DictConfig) -> Asset:
    """Return the asset that ``run=`` or ``ply=`` names; exactly one of them must be given."""
    if (cfg.run is None) == (cfg.ply is None):
        got = "neither" if cfg.run is None else "both"
        raise UserError(f"run, ply: expected one of them, got {got}. Try: run=outputs/latest")
    if cfg.run is not None:
        return open_run(find_run(cfg.run), cfg.device)
    ply = Path(cfg.ply).expanduser()
    gaussians = read_ply(ply, up=cfg.ply_up).to(resolve_device(cfg.device))
    return Asset(gaussians=gaussians, ply=ply, folder=ply.with_suffix(""))


def open_run(folder: Path, device: str) -> Asset:
    """Return the asset of the run in ``folder``."""
    ply = folder / ASSET
    if not ply.is_file():
        raise UserError(f"{shown(folder)}: has no {ASSET} yet. Try: cadam3d train resume={shown(folder)}")
    return Asset(gaussians=read_ply(ply).to(resolve_device(device)), ply=ply, folder=folder)


def find_run(text: str) -> Path:
    """Return the folder of the run that ``text`` names. Raises ``UserError`` if it does not hold a run."""
    folder = Path(text).expanduser().resolve()
    example = "run=outputs/latest"
    if (folder / CONFIG).is_file():
        return folder
    if not folder.is_dir():
        reason = "no such folder"
    elif is_sweep(folder):
        reason = "it is a sweep, which has many runs"
        started = [config.parent for config in sorted(folder.glob(f"*/{CONFIG}"))]
        example = f"run={shown(started[0])}" if started else example
    else:
        reason = f"it has no {CONFIG}"
    raise UserError(f"run: expected the folder of a run, got {text!r} ({reason}). Try: {example}")


def run_config(folder: Path) -> DictConfig:
    """Return the settings of the run in ``folder``."""
    return load_config(folder / CONFIG)


def renderer(rasterizer: DictConfig, gaussians: Gaussians) -> RenderFn:
    """Return a function that renders ``gaussians`` and prepares the configured rasterizer at first use."""
    built: Rasterizer = component(rasterizer)
    render = render_fn(built, lambda: gaussians)

    def render_with_note(cameras: Cameras, background: Float[Tensor, "v 3"]) -> RenderOutput:
        note_backend(built.prepare(gaussians.device))
        return render(cameras, background)

    return render_with_note


def export_all(cfg: DictConfig, asset: Asset, folder: Path) -> list[Path]:
    """Run every exporter of ``cfg`` on ``asset``, and return the paths of the files in ``folder``."""
    exporters: Sequence[Exporter] = list(components(cfg.exporter).values())
    if not exporters:
        raise UserError("exporter: expected at least one, got none. Try: exporter=[images,turntable]")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = error.strerror or error
        raise UserError(f"output: cannot write to {folder} ({reason}). Try: output=/tmp/cadam3d") from error
    render = renderer(cfg.rasterizer, asset.gaussians)
    return [path for exporter in exporters for path in exporter.export(asset.gaussians, render, folder)]


def output_folder(cfg: DictConfig, asset: Asset, name: str) -> Path:
    """Return the folder that ``output=`` names, by default ``name`` beside the asset."""
    return Path(cfg.output).expanduser() if cfg.output else asset.folder / name
