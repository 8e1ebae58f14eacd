"""``cadam3d export``: write an asset in the formats that other programs read."""

import unicodedata
from collections.abc import Sequence
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf

from cadam3d import __version__
from cadam3d.commands.asset import Asset, Output, export_all, open_asset, write_files
from cadam3d.commands.messages import note
from cadam3d.core.errors import UserError
from cadam3d.core.mesh.surface import SurfaceFacts
from cadam3d.exporter.programs import FORMATS, OTHER, hint_of, judge, loss_of
from cadam3d.io.asset_record import (
    FileEntry,
    Frame,
    Source,
    facts_of,
    require_own_record,
    sha256_of,
    write_record,
)
from cadam3d.io.lock import taking_turns
from cadam3d.io.mesh import FORMATS as MESH_FORMATS
from cadam3d.io.mesh import mesh_facts
from cadam3d.io.run_folder import (
    ASSET_RECORD,
    CONFIG,
    EXPORTS,
    expanded,
    has_file,
    numbered,
    shown,
    typed_path,
)
from cadam3d.settings.compose import escape
from cadam3d.settings.line import setting_word

INDENT = "  "
MESH = "mesh"  # the exporter of triangles
# Values of ``format`` (mesh) and ``version`` (spz) for which the table of programs holds; "" for neither.
USUAL_VARIANTS = ("", "glb", "3")


def run(cfg: DictConfig) -> None:
    """Write ``output``: a file if it has a suffix, else a folder (by default ``exports`` beside the asset).

    Print a few lines about each file.
    """
    asset = open_asset(cfg)
    fill_in_title(cfg, asset)
    require_apart(asset, [] if cfg.output is None else [expanded(str(cfg.output))])
    for output in write_files(cfg, asset, EXPORTS, export_recorded):
        print("\n".join(described(cfg, asset, output)))


def fill_in_title(cfg: DictConfig, asset: Asset) -> None:
    """Make the prompt of the run the title of its page, in place, unless the line sets a title."""
    run_folder = run_of(asset)
    if "html" in cfg.exporter and run_folder is not None:
        prompt = facts_of(run_folder)["prompt"]
        if isinstance(prompt, str):
            set_title(cfg, prompt)


def set_title(cfg: DictConfig, title: str) -> None:
    """Make ``title`` that of the page, in place, if the line exports a page and sets no title."""
    key = "exporter.html.title"
    if "html" in cfg.exporter and OmegaConf.select(cfg, key) is None:
        # The text may be a stranger's, and a title has no control characters.
        plain = "".join(" " if unicodedata.category(each) == "Cc" else each for each in title)
        OmegaConf.update(cfg, key, escape(plain))


def run_of(asset: Asset) -> Path | None:
    """Return the folder of the run that made an asset; None for a file that is not the asset of a run."""
    return asset.folder if has_file(asset.folder, CONFIG) else None


def export_recorded(cfg: DictConfig, asset: Asset, folder: Path) -> list[Output]:
    """Run every exporter, describe the files in asset.json, and return all of them.

    Other exports into the same folder wait meanwhile, because both would write the same asset.json.
    Raises ``UserError`` if all exporters fail, or if the folder has an asset.json of another origin.
    """
    with taking_turns(folder, lambda: note(f"waiting for another export into {shown(folder)}")):
        require_own_record(folder)
        names = [FORMATS[name].file for name in cfg.exporter if name in FORMATS]
        require_apart(asset, [folder / name for name in names])
        source = Source(
            name=asset.ply.name,
            sha256=sha256_of(asset.ply),
            gaussians=len(asset.gaussians),
            sh_degree=asset.gaussians.sh_degree,
            run=run_of(asset),
        )
        outputs = export_all(cfg, asset, folder)
        entries = [entry_of(cfg, asset, output) for output in outputs if is_asset(cfg, output)]
        if entries:
            versions = {"cadam3d": __version__, "torch": torch.__version__}
            record = write_record(folder, source, entries, exported_with=versions)
            outputs.append(Output(record, ASSET_RECORD))
        return outputs


def require_apart(asset: Asset, paths: Sequence[Path]) -> None:
    """Raise ``UserError`` if one of ``paths`` is the file that is exported, which would be overwritten."""
    source = typed_path(str(asset.ply))
    if any(typed_path(str(path)) == source for path in paths):
        free = numbered(asset.ply.with_name(EXPORTS), first=1)
        raise UserError(
            f"output: expected another place than {shown(asset.ply)}, which is exported, got the same. "
            f"Try: {setting_word('output', shown(free))}"
        )


def is_asset(cfg: DictConfig, output: Output) -> bool:
    """Return whether a file holds the asset itself, not a picture of it."""
    return output.exporter in FORMATS or setting(cfg, output, "up") is not None


def setting(cfg: DictConfig, output: Output, name: str) -> object:
    """Return a setting of the exporter that has written a file; None if it has no such setting."""
    return OmegaConf.select(cfg.exporter, f"{output.exporter}.{name}")


def entry_of(cfg: DictConfig, asset: Asset, output: Output) -> FileEntry:
    """Return the description of a file for asset.json."""
    up = setting(cfg, output, "up")
    is_mesh = output.exporter == MESH
    facts = mesh_in(output) if is_mesh else None
    return FileEntry(
        name=output.path.name,
        format=output.exporter,
        bytes=output.path.stat().st_size,
        sha256=sha256_of(output.path),
        frame=None if up is None or (is_mesh and facts is None) else Frame.of(str(up)),
        sh_degree=None if is_mesh else degree_of(cfg, asset, output),
        gaussians=None if is_mesh else len(asset.gaussians),
        triangles=facts.triangles if facts else None,
    )


def degree_of(cfg: DictConfig, asset: Asset, output: Output) -> int:
    """Return the SH degree of a file of Gaussians."""
    degree, largest = asset.gaussians.sh_degree, FORMATS.get(output.exporter, OTHER).max_degree
    degree = degree if largest is None else min(degree, largest)
    padded = setting(cfg, output, "pad_sh")
    return max(degree, padded) if isinstance(padded, int) else degree


def described(cfg: DictConfig, asset: Asset, output: Output) -> list[str]:
    """Return the lines that are printed about a file: its content, and how other programs show it."""
    parts = [f"{shown(output.path)}  {size_in_words(output.path.stat().st_size)}"]
    if not is_asset(cfg, output):
        return [f"{parts[0]}, describes these files" if output.exporter == ASSET_RECORD else parts[0]]
    if output.exporter != MESH:
        count = len(asset.gaussians)
        parts.append(f"{count:,} Gaussian{'' if count == 1 else 's'}")
    elif facts := mesh_in(output):
        parts.append(str(facts))
    else:
        return [f"{parts[0]}, belongs to the mesh"]
    up = setting(cfg, output, "up")
    views = []
    if up is not None:
        parts.append(f"{up} up")
        views = views_in_words(kind_of(cfg, output), str(up))
    notes = [loss_of(output.exporter, asset.gaussians.sh_degree), hint_of(output.exporter)]
    return [", ".join(parts), *(INDENT + text for text in (*views, *notes) if text)]


def kind_of(cfg: DictConfig, output: Output) -> str:
    """Return the name under which the table of programs has a file: its exporter, or a variant of it."""
    variant = str(setting(cfg, output, "format") or setting(cfg, output, "version") or "")
    return output.exporter if variant in USUAL_VARIANTS else f"{output.exporter}.{variant}"


def views_in_words(exporter: str, up: str) -> list[str]:
    """Return in which programs a file is upright, and in which upside down (with the ``for=`` that helps)."""
    verdict = judge(exporter, up)
    groups = (
        ("upright in", [program.name for program in verdict.upright]),
        ("upside down in", [f"{program.name} (for={program.target})" for program in verdict.upside_down]),
        ("on its side in", [program.name for program in verdict.on_its_side]),
    )
    return [f"{words} {', '.join(names)}" for words, names in groups if names]


def size_in_words(size: int) -> str:
    """Return a number of bytes in MB, or in kB if that is more exact."""
    return f"{size / 1e6:,.2f} MB" if size >= 100_000 else f"{size / 1e3:.1f} kB"


def mesh_in(output: Output) -> SurfaceFacts | None:
    """Return numbers about a file of the mesh exporter; None for its texture or material."""
    is_mesh = output.path.suffix.removeprefix(".") in MESH_FORMATS
    return mesh_facts(output.path) if is_mesh else None
