"""``cadam3d view``: show the report of a run or a sweep, or a picture of a file. There is no live viewer."""

import os
import sys
import webbrowser
from pathlib import Path

from omegaconf import DictConfig

from cadam3d import report
from cadam3d.commands.asset import find_run, open_asset, write_outputs
from cadam3d.io.run_folder import REPORT, has_file, shown, typed_path
from cadam3d.sweep.folder import is_sweep


def run(cfg: DictConfig) -> None:
    """Show the report of ``run=``; for ``ply=``, or for a run without a report, show a picture."""
    page = _page(cfg)
    is_open = cfg.browser and has_display() and webbrowser.open(page.resolve().as_uri())
    print(f"{'Opened' if is_open else 'Open this in a browser:'} {shown(page)}")
    print("(This version has no live viewer; asset.ply opens in any 3D Gaussian splatting viewer.)")


def has_display() -> bool:
    """Return whether a window can appear; without one, a text browser would take over the terminal."""
    is_unix = sys.platform.startswith(("linux", "freebsd"))
    return not is_unix or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _page(cfg: DictConfig) -> Path:
    if cfg.run is not None and cfg.ply is None:
        folder = typed_path(str(cfg.run))
        if is_sweep(folder):
            return folder / REPORT if has_file(folder, REPORT) else report.write_sweep(folder)
        if has_file(find_run(str(cfg.run)), REPORT):
            return folder / REPORT
    return write_outputs(cfg, open_asset(cfg), "view")[0]
