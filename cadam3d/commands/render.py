"""``cadam3d render``: make pictures or videos of an asset, or of several runs side by side."""

from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from cadam3d.commands.export import export
from cadam3d.commands.opened import find_run, open_asset, open_run, renderer
from cadam3d.commands.writing import Output, chosen_exporters, run_exporters, write_files
from cadam3d.core.checks import fail
from cadam3d.core.console import show
from cadam3d.core.errors import UserError
from cadam3d.core.rendering import Subject
from cadam3d.exporter.base import Exporter
from cadam3d.io.caption import plain
from cadam3d.io.records import read_summary
from cadam3d.io.run_folder import LATEST, shown
from cadam3d.settings.compose import Call

# Runs side by side. The pictures of more would be too small for their captions.
MOST_RUNS = 12
LONGEST_LABEL = 80  # characters
LONGEST_NAME = 120  # characters of the folder of a comparison


def run(cfg: DictConfig, _call: Call) -> None:
    """Write ``output``: a file if it has a suffix, else a folder (by default ``render`` beside the asset).

    The pictures of several runs are by default in the folder ``compare`` of the first one.
    """
    if OmegaConf.is_list(cfg.run):
        outputs, subjects = _compare(cfg)
        of = "; ".join(f"{each.label}: {len(each.gaussians)} Gaussians" for each in subjects)
    else:
        asset = open_asset(cfg)
        outputs, of = export(cfg, asset, "render", has_record=False), f"{len(asset.gaussians)} Gaussians"
    show(f"{len(outputs)} file(s) of {of}:")
    for output in outputs:
        show(f"  {shown(output.path)}")


def _compare(cfg: DictConfig) -> tuple[list[Output], list[Subject]]:
    """Draw the runs in ``run=[...]`` side by side, and return the files and the runs."""
    if cfg.ply is not None:
        raise UserError("run, ply: expected one of them, got both. Try: ply=null")
    if not 2 <= len(cfg.run) <= MOST_RUNS:
        raise fail("run", expected=f"2 to {MOST_RUNS} runs", got=len(cfg.run), example=f"run={LATEST}")
    folders = [find_run(str(text)) for text in cfg.run]
    labels = default_labels(folders) if cfg.labels is None else [plain(label) for label in cfg.labels]
    if len(labels) != len(folders) or not all(0 < len(label) <= LONGEST_LABEL for label in labels):
        expected = f"one text of 1 to {LONGEST_LABEL} characters for each of the {len(folders)} runs"
        raise fail("labels", expected=expected, got=labels)
    assets = [open_run(folder, cfg.device) for folder in folders]
    subjects = [
        Subject(asset.gaussians, renderer(cfg.rasterizer, asset.gaussians), label)
        for asset, label in zip(assets, labels, strict=True)
    ]

    exporters = chosen_exporters(cfg)

    def write(folder: Path) -> list[Output]:
        def compare(exporter: Exporter) -> list[Path]:
            return exporter.compare(subjects, folder)

        return run_exporters(exporters, assets[0].gaussians, compare)[0]

    name = f"compare/{'+'.join(folder.name for folder in folders[1:])[:LONGEST_NAME]}"
    return write_files(cfg.output, assets[0], name, write, write), subjects


def default_labels(folders: Sequence[Path]) -> list[str]:
    """Return a label for each run: its densifier, or its folder or path if densifiers are equal."""
    densifiers = [str(read_summary(folder).get("densifier") or "") for folder in folders]
    for names in (densifiers, [folder.name for folder in folders]):
        labels = [plain(name) for name in names]
        if all(labels) and len(set(labels)) == len(labels):
            return [label[:LONGEST_LABEL] for label in labels]
    return [plain(str(shown(folder)))[-LONGEST_LABEL:] for folder in folders]
