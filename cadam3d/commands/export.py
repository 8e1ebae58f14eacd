"""``cadam3d export``: write an asset in the formats that other programs read."""

import unicodedata
from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from cadam3d.commands.messages import note
from cadam3d.commands.opened import OpenedAsset, open_asset, renderer
from cadam3d.commands.writing import Output, chosen_exporters, run_exporters, write_files
from cadam3d.core.errors import UserError
from cadam3d.exporter.base import Contents, Exporter
from cadam3d.exporter.programs import UPSIDE_DOWN, shown_as
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
from cadam3d.settings.compose import Call, escape

INDENT = "  "


def run(cfg: DictConfig, _call: Call) -> None:
    """Write ``output``: a file if it has a suffix, else a folder (by default ``exports`` beside the asset).

    Print a few lines about each file.
    """
    asset = open_asset(cfg)
    run_folder = run_of(asset)
    if run_folder is not None:
        set_title(cfg, facts_of(run_folder)["prompt"])
    for output in export(cfg, asset, EXPORTS, has_record=True):
        print("\n".join(described(output, asset)))


def export(cfg: DictConfig, asset: OpenedAsset, name: str, *, has_record: bool) -> list[Output]:
    """Run the exporters of ``cfg`` on ``asset``, and return the files that they have written.

    ``name`` is the folder beside the asset for a line without ``output=``. With ``has_record``, a folder of
    files gets an asset.json. Raises ``UserError`` if all exporters fail, or if one would overwrite the asset.
    """
    exporters = chosen_exporters(cfg)
    render = renderer(cfg.rasterizer, asset.gaussians)
    require_apart(asset, [] if cfg.output is None else [expanded(str(cfg.output))])

    def into_file(folder: Path) -> list[Output]:
        def write(exporter: Exporter) -> list[Path]:
            return exporter.export(asset.gaussians, render, folder)

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
    contents = [(output, contents_of(output, asset)) for output in outputs]
    entries = [entry_of(output, found) for output, found in contents if found is not None]
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
        raise UserError(
            f"output: expected another place than {shown(asset.file)}, which is exported, got the same. "
            f"Try: {setting_word('output', shown(free))}"
        )


def contents_of(output: Output, asset: OpenedAsset) -> Contents | None:
    """Return what a file holds of the asset; None for a picture."""
    return None if output.exporter is None else output.exporter.contents(output.path, asset.gaussians)


def entry_of(output: Output, contents: Contents) -> FileEntry:
    """Return the description of a file for asset.json."""
    return FileEntry(
        name=output.path.name,
        format=output.name,
        bytes=output.path.stat().st_size,
        sha256=sha256_of(output.path),
        frame=None if contents.up is None else axes_of(contents.up),
        sh_degree=contents.sh_degree,
        gaussians=contents.gaussians,
        triangles=contents.triangles,
    )


def described(output: Output, asset: OpenedAsset) -> list[str]:
    """Return the lines that are printed about a file: its content, and how other programs show it."""
    first = f"{shown(output.path)}  {size_in_words(output.path.stat().st_size)}"
    exporter, contents = output.exporter, contents_of(output, asset)
    if exporter is None:
        return [f"{first}, describes these files"]
    if contents is None:
        return [first]
    first = f"{first}, {contents.words}"
    if contents.gaussians is None and contents.triangles is None:
        return [first]
    notes = [exporter.losses(asset.gaussians.sh_degree), exporter.hint]
    if contents.up is not None:
        first = f"{first}, {contents.up} up"
        kind = f"{output.name}.{exporter.variant}" if exporter.variant else output.name
        notes = [*views_in_words(kind, contents.up), *notes]
    return [first, *(INDENT + text for text in notes if text)]


def views_in_words(exporter: str, up: str) -> list[str]:
    """Return in which programs a file is upright, and in which upside down (with the ``for=`` that helps)."""
    lines = []
    for way, programs in shown_as(exporter, up).items():
        names = [f"{each.name} (for={each.target})" if way == UPSIDE_DOWN else each.name for each in programs]
        lines += [f"{way} in {', '.join(names)}"] if names else []
    return lines


def size_in_words(size: int) -> str:
    """Return a number of bytes in MB, or in kB if that is more exact."""
    return f"{size / 1e6:,.2f} MB" if size >= 100_000 else f"{size / 1e3:.1f} kB"
