"""report.html of a run: one file with its result, its charts and its settings."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cadam3d.core.chart import Chart
from cadam3d.io.declarations import write_declarations
from cadam3d.io.html import data_url, source
from cadam3d.io.records import MEASUREMENTS, NUMBERS, declared
from cadam3d.io.run_folder import ASSET, CONFIG, METRICS, PREVIEW, REPORT, SUMMARY, TURNTABLE
from cadam3d.report.charts import lines_of, sections
from cadam3d.report.formatting import elapsed, number, shown_bytes
from cadam3d.report.growth import frames
from cadam3d.report.pages import TEMPLATES, Tile, table, write_page
from cadam3d.viewer.page import script, style

EMBED_BYTES = 8 << 20  # a larger video is linked, not embedded
FILES = (ASSET, TURNTABLE, PREVIEW, SUMMARY, METRICS, CONFIG)
HIDDEN = ("warnings", MEASUREMENTS, NUMBERS)  # entries of the summary that are no facts
COMPONENTS = ("densifier", "guidance", "prior", "rasterizer", "initializer", "device")
# Entries of the summary, in the order of the page. Those that are not here follow under their own names.
LABELS = {
    "prompt": "Prompt",
    "negative_prompt": "Negative prompt",
    "outcome": "Outcome",
    "num_gaussians_initial": "Gaussians at the start",
    "initializer_note": "Fallback of the initializer",
    "backend": "Rasterizer backend",
    "backend_reason": "Why not a faster backend",
    "steps": "Steps done",
    "steps_asked": "Steps requested",
    "skipped_steps": "Steps skipped (gradient not finite)",
    "dimmed_steps": "Steps that dimmed all colours",
    "grows": "Adds Gaussians",
    "memory_estimate_gib": "Memory, estimated (GiB)",
    "memory_peak_gib": "Memory of the GPU at its peak (GiB)",
    "cadam3d": "Version of cadam3d",
    "torch": "Version of torch",
}


def write(
    folder: Path,
    *,
    summary: Mapping[str, Any],
    metrics: Sequence[Mapping[str, Any]],
    config_text: str,
    charts: Sequence[Chart],
) -> Path:
    """Write ``charts.json`` and ``report.html`` of the run in ``folder`` and return the path of the page.

    The page leaves out whatever is missing from ``summary`` (the content of ``summary.json``) and ``metrics``
    (the lines of ``metrics.jsonl``). ``preview.png`` and, up to 8 MiB, ``turntable.mp4`` are embedded if they
    exist. Raises ``UserError`` if a file cannot be written.
    """
    write_declarations(folder, charts)
    _, refinements = lines_of(metrics)
    video, preview = folder / TURNTABLE, folder / PREVIEW
    return write_page(
        folder / REPORT,
        "run.html.jinja",
        title=str(summary.get("prompt") or "Untitled"),
        outcome=str(summary.get("outcome", "unknown")),
        components=[(name, summary[name]) for name in (*COMPONENTS, "seed") if summary.get(name) is not None],
        warnings=summary.get("warnings") or (),
        tiles=_tiles(summary),
        video=_video_source(video) if video.is_file() else "",
        video_name=TURNTABLE,
        preview=data_url(preview, "image/png") if preview.is_file() else "",
        frames=frames(folder, int(number(summary.get("steps")) or 0)),
        view_style=style(),
        view_script=f"{script()}{source(TEMPLATES / 'growth.js')}",
        sections=sections(metrics, charts),
        facts=_facts(summary),
        refinements=table([{k: v for k, v in line.items() if k != "kind"} for line in refinements]),
        config_text=config_text,
        files=[name for name in FILES if (folder / name).is_file()],
    )


def _tiles(summary: Mapping[str, Any]) -> list[Tile]:
    """Return the numbers that matter most, as far as they are known."""
    found = {name: value for name in summary if (value := number(summary[name])) is not None}
    tiles = []
    if (count := found.get("num_gaussians")) is not None:
        initial = found.get("num_gaussians_initial")
        tiles.append(Tile("Gaussians", f"{count:,.0f}", "" if initial is None else f"from {initial:,.0f}"))
    preferred = [
        each for each in declared(summary).values() if each.preference is not None and each.name in found
    ]
    for each in sorted(preferred, key=lambda each: (each.preference, not each.replaces))[:1]:
        tiles.append(Tile(each.label, each.written(found[each.name]), ""))
    if (size := found.get("asset_bytes")) is not None:
        tiles.append(Tile(ASSET, shown_bytes(size), ""))
    if (seconds := found.get("seconds")) is not None:
        steps = found.get("steps")
        tiles.append(Tile("Time", elapsed(seconds), f"{steps:,.0f} steps" if steps else ""))
    return tiles


def _video_source(path: Path) -> str:
    return data_url(path, "video/mp4") if path.stat().st_size <= EMBED_BYTES else path.name


def _facts(summary: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Return the label and the value of every fact, the known ones first."""
    labels = LABELS | {name: each.fact for name, each in declared(summary).items()}
    ordered = [*(key for key in labels if key in summary), *(key for key in summary if key not in labels)]
    return [
        (labels.get(key) or key.capitalize().replace("_", " "), summary[key])
        for key in ordered
        if key not in HIDDEN
    ]
