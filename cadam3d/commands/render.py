"""``cadam3d render``: make pictures or videos of an asset."""

from omegaconf import DictConfig

from cadam3d.commands.asset import export_all, open_asset, output_folder
from cadam3d.io.run_folder import shown


def run(cfg: DictConfig) -> None:
    """Run the exporters and write their files into ``output``, by default ``render/`` beside the asset."""
    asset = open_asset(cfg)
    folder = output_folder(cfg, asset, "render")
    paths = export_all(cfg, asset, folder)
    print(f"{len(paths)} files of {len(asset.gaussians)} Gaussians in {shown(folder)}:")
    for path in paths:
        print(f"  {shown(path)}")
