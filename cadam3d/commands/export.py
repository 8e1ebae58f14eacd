"""``cadam3d export``: write an asset in the format that another program needs."""

from omegaconf import DictConfig

from cadam3d.commands.asset import open_asset, write_outputs
from cadam3d.io.run_folder import shown


def run(cfg: DictConfig) -> None:
    """Write ``output``: a file if it has a suffix, else a folder (by default ``export`` beside the asset)."""
    asset = open_asset(cfg)
    for path in write_outputs(cfg, asset, "export"):
        print(f"{shown(path)}  {path.stat().st_size / 1e6:.2f} MB, {len(asset.gaussians)} Gaussians")
