"""Opened assets: the results of a run, or a single file, for all commands that use them."""

from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float
from omegaconf import DictConfig
from torch import Tensor

from cadam3d.build import component
from cadam3d.commands.messages import note_backend
from cadam3d.core.cameras import Cameras
from cadam3d.core.checks import require, require_choice
from cadam3d.core.device import resolve_device
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.rendering import RenderFn, RenderOutput
from cadam3d.io.asset_file import read_gaussians
from cadam3d.io.frames import UPS
from cadam3d.io.run_folder import (
    ASSET,
    CONFIG,
    LATEST,
    expanded,
    has_file,
    shown,
    typed_path,
)
from cadam3d.rasterizer.base import Rasterizer, render_fn
from cadam3d.settings.line import continuing


@dataclass(frozen=True)
class OpenedAsset:
    """Gaussians from a file of any format, on the requested device."""

    gaussians: Gaussians
    file: Path
    folder: Path  # of the run, or named after a single file


def open_asset(cfg: DictConfig) -> OpenedAsset:
    """Return the asset that ``run=`` or ``ply=`` names; exactly one of them must be given."""
    require_one(cfg)
    if cfg.run is not None:
        return open_run(find_run(str(cfg.run)), cfg.device)
    ply = expanded(str(cfg.ply))
    gaussians = read_gaussians(ply, up=cfg.ply_up).to(resolve_device(cfg.device))
    return OpenedAsset(gaussians=gaussians, file=ply, folder=ply.with_suffix(""))


def require_one(cfg: DictConfig) -> None:
    """Raise ``UserError`` unless exactly one of ``run=`` and ``ply=`` is given.

    The value of ``ply_up=`` must be an axis or null.
    """
    if (cfg.run is None) == (cfg.ply is None):
        got, line = ("neither", f"run={LATEST}") if cfg.run is None else ("both", "ply=null")
        raise UserError(f"run, ply: expected one of them, got {got}. Try: {line}")
    if cfg.ply_up is not None:
        require_choice("ply_up", cfg.ply_up, UPS)


def find_asset(folder: Path) -> Path:
    """Return the path of the asset of the run in ``folder``. Raises ``UserError`` if it has none yet."""
    ply = folder / ASSET
    if not has_file(ply):
        line = f"{continuing(folder)} 'exporter=[ply]'"
        raise UserError(f"{shown(folder)}: has no {ASSET} yet. Try: {line}")
    return ply


def open_run(folder: Path, device: str) -> OpenedAsset:
    """Return the asset of the run in ``folder``."""
    ply = find_asset(folder)
    return OpenedAsset(gaussians=read_gaussians(ply).to(resolve_device(device)), file=ply, folder=folder)


def find_run(text: str) -> Path:
    """Return the folder of the run that ``text`` names. Raises ``UserError`` if it does not hold a run."""
    folder = typed_path(text)
    expected = f"the folder of a run, with a {CONFIG}"
    require(has_file(folder, CONFIG), "run", expected=expected, got=text, example=f"run={LATEST}")
    return folder


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
