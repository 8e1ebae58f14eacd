"""``cadam3d export``: write an asset in the formats that other programs read."""

from collections.abc import Sequence
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf

from cadam3d import __version__
from cadam3d.commands.asset import Asset, Output, export_all, open_asset, write_files
from cadam3d.commands.messages import note
from cadam3d.exporter.programs import FORMATS, Format, Program, judge, losses
from cadam3d.io.asset_record import FileEntry, Frame, Source, require_own_record, sha256_of, write_record
from cadam3d.io.lock import taking_turns
from cadam3d.io.run_folder import ASSET_RECORD, CONFIG, EXPORTS, has_file, shown

INDENT = "  "
MESH_SUFFIXES = (".glb", ".obj", ".ply")


def run(cfg: DictConfig) -> None:
    """Write ``output``: a file if it has a suffix, else a folder (by default ``exports`` beside the asset).

    Print a few lines about each file.
    """
    asset = open_asset(cfg)
    for output in write_files(cfg, asset, EXPORTS, export_recorded):
        print("\n".join(described(cfg, asset, output)))


def export_recorded(cfg: DictConfig, asset: Asset, folder: Path) -> list[Output]:
    """Run every exporter, describe the files in asset.json, and return all of them.

    Other exports into the same folder wait meanwhile, so that no record describes a file of another process.
    Raises ``UserError`` if all exporters fail, or if the folder has an asset.json of another origin.
    """
    with taking_turns(folder, lambda: note(f"waiting for another export into {shown(folder)}")):
        require_own_record(folder)
        outputs = export_all(cfg, asset, folder)
        entries = [entry_of(cfg, asset, output) for output in outputs if is_asset(cfg, output)]
        if entries:
            source = Source(
                file=asset.ply,
                run=asset.folder if has_file(asset.folder, CONFIG) else None,
                gaussians=len(asset.gaussians),
                sh_degree=asset.gaussians.sh_degree,
            )
            versions = {"cadam3d": __version__, "torch": torch.__version__}
            record = write_record(folder, source, entries, exported_with=versions)
            outputs.append(Output(record, ASSET_RECORD))
        return outputs


def is_asset(cfg: DictConfig, output: Output) -> bool:
    """Return whether a file holds the asset itself, not a picture of it."""
    return output.exporter in FORMATS or setting(cfg, output, "up") is not None


def setting(cfg: DictConfig, output: Output, name: str) -> object:
    """Return a setting of the exporter that has written a file; None if it has no such setting."""
    return OmegaConf.select(cfg.exporter, f"{output.exporter}.{name}")


def entry_of(cfg: DictConfig, asset: Asset, output: Output) -> FileEntry:
    """Return the description of a file for asset.json."""
    format_ = FORMATS.get(output.exporter, Format())
    up = setting(cfg, output, "up")
    return FileEntry(
        name=output.path.name,
        format=output.exporter,
        bytes=output.path.stat().st_size,
        sha256=sha256_of(output.path),
        frame=None if up is None else Frame.of(str(up)),
        sh_degree=None if format_.is_mesh else degree_of(cfg, asset, output),
        gaussians=None if format_.is_mesh else len(asset.gaussians),
        triangles=triangles_in(output.path) if format_.is_mesh else None,
    )


def degree_of(cfg: DictConfig, asset: Asset, output: Output) -> int:
    """Return the SH degree of a file of Gaussians."""
    degree = min(asset.gaussians.sh_degree, FORMATS.get(output.exporter, Format()).max_degree)
    padded = setting(cfg, output, "pad_sh")
    return max(degree, padded) if isinstance(padded, int) else degree


def described(cfg: DictConfig, asset: Asset, output: Output) -> list[str]:
    """Return the lines that are printed about a file: its content, and how other programs show it."""
    first = f"{shown(output.path)}  {size_in_words(output.path.stat().st_size)}"
    if not is_asset(cfg, output):
        return [f"{first}, describes these files" if output.exporter == ASSET_RECORD else first]
    format_ = FORMATS.get(output.exporter, Format())
    up = setting(cfg, output, "up")
    count, unit = len(asset.gaussians), "Gaussians"
    if format_.is_mesh:
        count, unit = triangles_in(output.path), "triangles"
    if count is None:
        return [f"{first}, belongs to the mesh"]
    first = f"{first}, {count:,} {unit}" + (f", {up} up" if up is not None else "")
    verdicts = [] if up is None else views_in_words(output.exporter, str(up))
    notes = [*losses(output.exporter, asset.gaussians.sh_degree), *([format_.hint] if format_.hint else [])]
    return [first, *(INDENT + "; ".join(parts) for parts in (verdicts, notes) if parts)]


def views_in_words(exporter: str, up: str) -> list[str]:
    """Return in which programs a file is upright, and in which it is not, with the ``for=`` that helps."""
    verdict = judge(exporter, up)
    groups = (
        ("upright in", verdict.upright, False),
        ("upside down in", verdict.upside_down, True),
        ("on its side in", verdict.on_its_side, True),
    )
    return [f"{words} {listed(programs, is_wrong)}" for words, programs, is_wrong in groups if programs]


def listed(programs: Sequence[Program], is_wrong: bool) -> str:
    """Return the names of programs, each with its ``for=`` if the file is wrong there."""
    return ", ".join(
        f"{program.name} (for={program.target})" if is_wrong and program.target else program.name
        for program in programs
    )


def size_in_words(size: int) -> str:
    """Return a number of bytes in MB, or in kB if that is more exact."""
    return f"{size / 1e6:,.2f} MB" if size >= 100_000 else f"{size / 1e3:.1f} kB"


def triangles_in(path: Path) -> int | None:
    """Return the number of triangles in a file of the mesh exporter; None for its texture or material."""
    if path.suffix not in MESH_SUFFIXES:
        return None
    # Loading it takes more than a second, and most exports write no mesh.
    import trimesh

    mesh = trimesh.load(path, force="mesh", process=False)
    assert isinstance(mesh, trimesh.Trimesh), "the exporter writes triangles"
    return len(mesh.faces)
