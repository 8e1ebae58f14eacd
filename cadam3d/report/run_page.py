"""report.html of a run: one file with its result, its charts and its settings."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cadam3d.core.errors import UserError
from cadam3d.core.number import COUNT, preferred
from cadam3d.io.declarations import read_declarations
from cadam3d.io.html import data_url, encoded, source
from cadam3d.io.ply import read_ply
from cadam3d.io.reading import read_bytes
from cadam3d.io.records import MEASUREMENTS, NUMBERS, declared, read_metrics, read_summary
from cadam3d.io.run_folder import ASSET, CONFIG, METRICS, PREVIEW, REPORT, SUMMARY, TURNTABLE, snapshots
from cadam3d.report.charts import lines_of, sections
from cadam3d.report.formatting import elapsed, number
from cadam3d.report.pages import TEMPLATES, table, write_page
from cadam3d.viewer.pack import pack
from cadam3d.viewer.page import script, style

MIB = 1 << 20
EMBED_BYTES = 8 * MIB  # a larger video is linked, not embedded
LARGEST = 8 * MIB  # of all snapshots in a page; base64 makes a third more of them
FILES = (ASSET, TURNTABLE, PREVIEW, SUMMARY, METRICS, CONFIG)
HIDDEN = ("warnings", MEASUREMENTS, NUMBERS)  # entries of the summary that are no facts
COMPONENTS = ("densifier", "guidance", "prior", "rasterizer", "initializer", "device")
# Labels of entries of the summary. The others have their own names.
LABELS = {
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


def write(folder: Path) -> Path:
    """Write ``report.html`` of the run in ``folder`` from its files, and return the path of the page.

    The page leaves out whatever is missing. ``preview.png`` and, up to 8 MiB, ``turntable.mp4`` are embedded
    if they exist. Raises ``UserError`` if a file cannot be written.
    """
    summary, metrics = read_summary(folder), read_metrics(folder)
    _, refinements = lines_of(metrics)
    video, preview, config = folder / TURNTABLE, folder / PREVIEW, folder / CONFIG
    shown_video = TURNTABLE if video.is_file() else ""
    if shown_video and video.stat().st_size <= EMBED_BYTES:
        shown_video = data_url(video, "video/mp4")
    return write_page(
        folder / REPORT,
        "run.html.jinja",
        title=str(summary.get("prompt") or "Untitled"),
        outcome=str(summary.get("outcome", "unknown")),
        components=[(name, summary[name]) for name in (*COMPONENTS, "seed") if summary.get(name) is not None],
        warnings=summary.get("warnings") or (),
        tiles=_tiles(summary),
        video=shown_video,
        video_name=TURNTABLE,
        preview=data_url(preview, "image/png") if preview.is_file() else "",
        frames=frames(folder, int(number(summary.get("steps")) or 0)),
        view_style=style(),
        view_script=f"{script()}{source(TEMPLATES / 'growth.js')}",
        sections=sections(metrics, read_declarations(folder)),
        facts=_facts(summary),
        refinements=table([{k: v for k, v in line.items() if k != "kind"} for line in refinements]),
        config_text=config.read_text(encoding="utf-8") if config.is_file() else "",
        files=[name for name in FILES if (folder / name).is_file()],
    )


def _tiles(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the numbers that matter most, as far as they are known: a label and a value."""
    known = [each for each in declared(summary).values() if number(summary.get(each.name)) is not None]
    shown = [each for each in known if each.name == COUNT.name] + preferred(known)[:1]
    tiles = [(each.label, each.written(summary[each.name])) for each in shown]
    if (size := number(summary.get("asset_bytes"))) is not None:
        tiles.append((ASSET, f"{size / MIB:.2f} MiB"))
    if (seconds := number(summary.get("seconds"))) is not None:
        tiles.append(("Time", elapsed(seconds)))
    return tiles


def frames(folder: Path, steps: int) -> list[tuple[int, str]]:
    """Return steps and snapshots of the run in ``folder``, in order and in base64, for the 3D view of a page.

    The last one is the object after ``steps`` steps. Together they have at most ``LARGEST`` bytes. If there
    are more, every second of them is left out, or two of three, and so on, but never the last one. The result
    is empty if nothing can be read, or if the last one alone is too large.
    """
    paths = {step: path for step, path in snapshots(folder).items() if step <= steps}
    try:
        found = {step: read_bytes(path, largest=LARGEST) for step, path in paths.items()}
        if steps not in found:
            found[steps] = pack(read_ply(folder / ASSET))
    except UserError:
        # A file that cannot be read costs the picture, not the report.
        return []
    backwards = sorted(found, reverse=True)
    for stride in range(1, len(backwards) + 1):
        kept = sorted(backwards[::stride])
        if sum(len(found[step]) for step in kept) <= LARGEST:
            return [(step, encoded(found[step])) for step in kept]
    return []


def _facts(summary: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Return the label and the value of every fact."""
    labels = LABELS | {name: each.fact for name, each in declared(summary).items()}
    return [
        (labels.get(key) or key.capitalize().replace("_", " "), value)
        for key, value in summary.items()
        if key not in HIDDEN
    ]
