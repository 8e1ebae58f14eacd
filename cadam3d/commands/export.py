"""``cadam3d export``: write an asset in the formats that other programs read."""

import unicodedata
from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from cadam3d.build import component
from cadam3d.commands.messages import note
from cadam3d.commands.opened import OpenedAsset, open_asset, renderer
from cadam3d.commands.writing import Output, chosen_exporters, run_exporters, write_files
from cadam3d.core.checks import fail
from cadam3d.core.console import show
from cadam3d.exporter.base import Exporter
from cadam3d.io.asset_record import FileEntry, axes_of, facts_of, require_own_record, sha256_of, write_record
from cadam3d.io.lock import taking_turns
from cadam3d.io.run_folder import (
    CONFIG,
    EXPORTS,
    expanded,
    has_file,
    numbered,
    setting_word,
    shown,
    typed_path,
)
from cadam3d.rasterizer.base import Rasterizer
from cadam3d.settings.compose import Call, escape


def run(cfg: DictConfig, _call: Call) -> None:
    """Write ``output``: a file if it has a suffix, else a folder (by default ``exports`` beside the asset).

    Print a few lines about each file.
    """
    asset = open_asset(cfg)
    run_folder = run_of(asset)
    if run_folder is not None:
        set_title(cfg, facts_of(run_folder)["prompt"])
    for output in export(cfg, asset, EXPORTS, has_record=True):
        show("\n".join(described(output, asset)))


def export(cfg: DictConfig, asset: OpenedAsset, name: str, *, has_record: bool) -> list[Output]:
    """Run the exporters of ``cfg`` on ``asset``, and return the files that they have written.

    ``name`` is the folder beside the asset for a line without ``output=``. With ``has_record``, a folder of
    files gets an asset.json. Raises ``UserError`` if all exporters fail, or if one would overwrite the asset.
    """
    exporters = chosen_exporters(cfg)
    render = renderer(cfg.rasterizer, asset.gaussians)
    rasterizer: Rasterizer = component(cfg.rasterizer, Rasterizer, "rasterizer")
    require_apart(asset, [] if cfg.output is None else [expanded(str(cfg.output))])

    def into_file(folder: Path) -> list[Output]:
        def write(exporter: Exporter) -> list[Path]:
            chosen = exporter.simplified(asset.gaussians, rasterizer.render)
            return exporter.export(chosen, render, folder)

        return run_exporters(exporters, asset.gaussians, write)[0]

    def into_folder(folder: Path) -> list[Output]:
        require_apart(asset, [folder / exporter.file_name for exporter in exporters.values()])
        if not has_record:
            return into_file(folder)
        # Two exports into the same folder would write the same asset.json.
        with taking_turns(folder, lambda: note(f"waiting for another export into {shown(folder)}")):
            require_own_record(folder)
            outputs = into_file(folder)
            return [*outputs, *recorded(folder, asset, outputs)]

    return write_files(cfg.output, asset, name, into_folder, into_file)


def recorded(folder: Path, asset: OpenedAsset, outputs: Sequence[Output]) -> list[Output]:
    """Describe the files of the asset itself in asset.json and return it, unless there are only pictures."""
    entries = []
    for output in outputs:
        exporter, path = output.exporter, output.path
        contents = None if exporter is None else exporter.contents(path, asset.gaussians)
        if contents is None:
            continue
        entries.append(
            FileEntry(
                name=path.name,
                format=output.name,
                bytes=path.stat().st_size,
                sha256=sha256_of(path),
                frame=None if contents.up is None else axes_of(contents.up),
                sh_degree=contents.sh_degree,
                gaussians=contents.gaussians,
                triangles=contents.triangles,
            )
        )
    if not entries:
        return []
    source = {
        "name": asset.file.name,
        "sha256": sha256_of(asset.file),
        "gaussians": len(asset.gaussians),
        "sh_degree": asset.gaussians.sh_degree,
    }
    return [Output(write_record(folder, source, entries, run=run_of(asset)), "", None)]


def set_title(cfg: DictConfig, title: object) -> None:
    """Use the text ``title`` as the page's title, in place, if the line exports a page and sets no title."""
    key = "exporter.html.title"
    if isinstance(title, str) and "html" in cfg.exporter and OmegaConf.select(cfg, key) is None:
        # The text may be a stranger's, and a title has no control characters.
        plain = "".join(" " if unicodedata.category(each) == "Cc" else each for each in title)
        OmegaConf.update(cfg, key, escape(plain))


def run_of(asset: OpenedAsset) -> Path | None:
    """Return the folder of the run that made an asset; None for a file that is not the asset of a run."""
    return asset.folder if has_file(asset.folder, CONFIG) else None


def require_apart(asset: OpenedAsset, paths: Sequence[Path]) -> None:
    """Raise ``UserError`` if one of ``paths`` is the file that is exported, which would be overwritten."""
    source = typed_path(str(asset.file))
    if any(typed_path(str(path)) == source for path in paths):
        free = numbered(asset.file.with_name(EXPORTS), first=1)
        expected = f"another place than {shown(asset.file)}, which is exported"
        raise fail("output", expected=expected, got="the same", example=setting_word("output", shown(free)))


def described(output: Output, asset: OpenedAsset) -> list[str]:
    """Return the lines that are printed about a file: its size and content, and what the format loses."""
    first = f"{shown(output.path)}  {output.path.stat().st_size / 1e6:,.3f} MB"
    exporter = output.exporter
    if exporter is None:
        return [f"{first}, describes these files"]
    contents = exporter.contents(output.path, asset.gaussians)
    if contents is None:
        return [first]
    up = "" if contents.up is None else f", {contents.up} up"
    notes = [exporter.losses(asset.gaussians.sh_degree), exporter.hint]
    return [f"{first}, {contents.words}{up}", *(f"  {text}" for text in notes if text)]
