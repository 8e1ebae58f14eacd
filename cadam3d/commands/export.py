"""``cadam3d export``: write an asset in the format that another program needs."""

import tempfile
from pathlib import Path

from omegaconf import DictConfig

from cadam3d.commands.asset import Asset, export_all, open_asset, output_folder
from cadam3d.core.errors import UserError
from cadam3d.io.run_folder import shown


def run(cfg: DictConfig) -> None:
    """Write ``output``: a file if it has a suffix, else a folder (by default ``export`` beside the asset)."""
    asset = open_asset(cfg)
    target = output_folder(cfg, asset, "export")
    paths = [_one_file(cfg, asset, target)] if target.suffix else export_all(cfg, asset, target)
    for path in paths:
        print(f"{shown(path)}  {path.stat().st_size / 1e6:.2f} MB, {len(asset.gaussians)} Gaussians")


def _one_file(cfg: DictConfig, asset: Asset, target: Path) -> Path:
    """Export into a folder beside ``target``, then move the file to its final name in a single step."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent, prefix=".export-") as folder:
            paths = export_all(cfg, asset, Path(folder))
            suffixes = {path.suffix for path in paths}
            if len(paths) != 1 or suffixes != {target.suffix}:
                raise UserError(
                    f"output={target}: the exporters write {len(paths)} file(s) with suffix "
                    f"{'|'.join(sorted(suffixes))}. Try: output={target.with_suffix('')}, a folder"
                )
            return paths[0].replace(target)
    except OSError as error:
        reason = error.strerror or error
        raise UserError(
            f"output: cannot write {target} ({reason}). Try: output=/tmp/{target.name}"
        ) from error
