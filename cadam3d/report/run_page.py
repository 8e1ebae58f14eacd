"""report.html of a run: one file with its result, its charts and its settings."""

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from cadam3d.core.chart import Chart
from cadam3d.io.records import MEASUREMENTS, NUMBERS, declared, psnr_of, ssim_of
from cadam3d.io.run_folder import ASSET, CONFIG, METRICS, PREVIEW, REPORT, SUMMARY, TURNTABLE
from cadam3d.report.charts import other_plots, sections
from cadam3d.report.declarations import write_declarations
from cadam3d.report.formatting import elapsed, number, shown_bytes
from cadam3d.report.growth import frames
from cadam3d.report.pages import TEMPLATES, Tile, data_url, table, write_page
from cadam3d.viewer.page import script, style

EMBED_BYTES = 8 << 20  # a larger video is linked, not embedded
FILES = (ASSET, TURNTABLE, PREVIEW, SUMMARY, METRICS, CONFIG)
HIDDEN = ("warnings", MEASUREMENTS, NUMBERS)  # entries of the summary that are no facts
COMPONENTS = ("densifier", "guidance", "prior", "rasterizer", "initializer", "device")
# The labels of the facts before those of metrics, and after them.
FIRST_LABELS = {
    "prompt": "Prompt",
    "negative_prompt": "Negative prompt",
    "outcome": "Outcome",
    "num_gaussians_initial": "Gaussians at the start",
    "initializer_note": "Fallback of the initializer",
}
LAST_LABELS = {
    "asset_bytes": "Size of asset.ply (bytes)",
    "backend": "Rasterizer backend",
    "backend_reason": "Why not a faster backend",
    "seconds": "Seconds",
    "steps": "Steps done",
    "steps_asked": "Steps requested",
    "skipped_steps": "Steps skipped (gradient not finite)",
    "dimmed_steps": "Steps that dimmed all colours",
    "seed": "Seed",
    "densifier": "Densifier",
    "guidance": "Guidance",
    "prior": "Prior",
    "truth": "Truth",
    "rasterizer": "Rasterizer",
    "initializer": "Initializer",
    "camera": "Camera",
    "refine": "Refinement",
    "optimizer": "Optimizer",
    "schedule": "Schedule",
    "device": "Device",
    "memory_estimate_gib": "Memory, estimated (GiB)",
    "memory_peak_gib": "Memory of the GPU at its peak (GiB)",
    "cadam3d": "Version of cadam3d",
    "torch": "Version of torch",
    "finished_at": "Finished at",
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
    steps = [line for line in metrics if line.get("kind") == "step"]
    refinements = [_flat(line) for line in metrics if line.get("kind") == "refine"]
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
        view_script=f"{script()}{_source()}",
        sections=sections(steps, refinements, charts),
        other_plots=other_plots(steps, refinements, charts),
        facts=_facts(summary),
        refinements=table([{k: v for k, v in line.items() if k != "kind"} for line in refinements]),
        config_text=config_text,
        files=[name for name in FILES if (folder / name).is_file()],
    )


@cache
def _source() -> str:
    return (TEMPLATES / "growth.js").read_text(encoding="utf-8")


def _tiles(summary: Mapping[str, Any]) -> list[Tile]:
    """Return the numbers that matter most, as far as they are known."""
    numbers = {name: number(value) for name, value in summary.items()}
    count, initial = numbers.get("num_gaussians"), numbers.get("num_gaussians_initial")
    size, per_gaussian = numbers.get("asset_bytes"), numbers.get("bytes_per_gaussian")
    psnr, ssim = psnr_of(numbers), ssim_of(numbers)
    done, asked, seconds = numbers.get("steps"), numbers.get("steps_asked"), numbers.get("seconds")
    tiles = []
    if count is not None:
        tiles.append(
            Tile("Gaussians", f"{count:,.0f}", f"from {initial:,.0f}" if initial is not None else "")
        )
    if psnr is not None:
        remark = f"SSIM {ssim:.3f}" if ssim is not None else "held-out views"
        start = numbers.get("psnr_start")
        remark += f", {start:.2f} dB at the start" if start is not None else ""
        tiles.append(Tile("PSNR", f"{psnr:.2f} dB", remark))
    if size is not None:
        remark = f"{per_gaussian:.0f} B per Gaussian" if per_gaussian else ""
        tiles.append(Tile(ASSET, shown_bytes(size), remark))
    if seconds is not None:
        rate = f"{done / seconds:.1f} steps per second" if done and seconds else ""
        tiles.append(Tile("Time", elapsed(seconds), rate))
    if done is not None and len(tiles) < 4:
        tiles.append(Tile("Steps", f"{done:,.0f}", f"of {asked:,.0f}" if asked is not None else ""))
    return tiles


def _video_source(path: Path) -> str:
    return data_url(path, "video/mp4") if path.stat().st_size <= EMBED_BYTES else path.name


def _facts(summary: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Return the label and the value of every fact, the known ones first."""
    measured = {name: each.fact for name, each in declared(summary).items()}
    labels = FIRST_LABELS | measured | {key: text for key, text in LAST_LABELS.items() if key not in measured}
    ordered = [*(key for key in labels if key in summary), *(key for key in summary if key not in labels)]
    return [(labels.get(key) or key.replace("_", " "), summary[key]) for key in ordered if key not in HIDDEN]


def _flat(line: Mapping[str, Any]) -> dict[str, Any]:
    """Return the line of a refinement with the densifier's statistics on the same level as the counts."""
    statistics = line.get("statistics")
    rest = {key: value for key, value in line.items() if key != "statistics"}
    return {**rest, **statistics} if isinstance(statistics, Mapping) else rest
