"""``cadam3d view``: show the report of a run, or a picture of a file. There is no live viewer yet."""

import os
import sys
import webbrowser
from pathlib import Path

from omegaconf import DictConfig

from cadam3d.commands.asset import export_all, find_run, open_asset, output_folder
from cadam3d.io.run_folder import REPORT, shown


def run(cfg: DictConfig) -> None:
    """Show the report of ``run=``. For ``ply=``, or without a report, make a picture and show that."""
    page = _page(cfg)
    is_open = cfg.browser and has_display() and webbrowser.open(page.resolve().as_uri())
    print(f"{'Opened' if is_open else 'Open this in a browser:'} {shown(page)}")
    print("(This version has no live viewer; asset.ply opens in any 3D Gaussian splatting viewer.)")


def has_display() -> bool:
    """Return whether a window can appear; without one, a text browser would take over the terminal."""
    is_unix = sys.platform.startswith(("linux", "freebsd"))
    return not is_unix or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _page(cfg: DictConfig) -> Path:
    if cfg.run is not None and cfg.ply is None and (report := find_run(cfg.run) / REPORT).is_file():
        return report
    asset = open_asset(cfg)
    return export_all(cfg, asset, output_folder(cfg, asset, "view"))[0]
