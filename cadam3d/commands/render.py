"""``cadam3d render``: make pictures or videos of an asset."""

from omegaconf import DictConfig

from cadam3d.commands.asset import open_asset, write_outputs
from cadam3d.io.run_folder import shown


def run(cfg: DictConfig) -> None:
    """Write ``output``: a file if it has a suffix, else a folder (by default ``render`` beside the asset)."""
    asset = open_asset(cfg)
    paths = write_outputs(cfg, asset, "render")
    files = "1 file" if len(paths) == 1 else f"{len(paths)} files"
    print(f"{files} of {len(asset.gaussians)} Gaussians:")
    for path in paths:
        print(f"  {shown(path)}")
