"""``cadam3d render``: pictures of an asset that was made before."""

from pathlib import Path

from omegaconf import DictConfig

from cadam3d.commands.asset import export_all, open_asset
from cadam3d.commands.paths import shown


def run(cfg: DictConfig) -> None:
    """Render what ``exporter`` asks for into ``output``, by default ``render/`` beside the asset."""
    asset = open_asset(cfg)
    folder = Path(cfg.output).expanduser() if cfg.output else asset.folder / "render"
    paths = export_all(cfg, asset, folder)
    print(f"{len(paths)} files of {len(asset.gaussians)} Gaussians in {shown(folder)}:")
    for path in paths:
        print(f"  {shown(path)}")
