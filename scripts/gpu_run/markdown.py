"""The record of a run as Markdown, for ``docs/notes/performance.md``."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from gpu_run.record import PASSED, Record

GIB, MB = 2**30, 1e6


def show(record: Record) -> str:
    """Return the whole record: the machine, one table of all results, and how to make it again."""
    lines = [*machine(record), "", *table(("what", "scene", "result"), rows(record)), ""]
    return "\n".join(
        [*lines, "Measured with `python scripts/gpu.py`; times are medians in milliseconds.", ""]
    )


def machine(record: Record) -> list[str]:
    """Return the machine in a few words, on lines that fit a page."""
    found = record.machine
    commit = f"commit {found['commit']}" if found["commit"] else "no checkout"
    packages = ", ".join(f"{name} {number}" for name, number in found["packages"].items())
    tools = ", ".join(found["tools"]) or "none"
    return [
        f"{found['device']} ({found['memory_bytes'] / GIB:.0f} GiB), capability {found['capability']}, "
        f"driver {found['driver'] or 'unknown'} (up to CUDA {found['driver_cuda']}),",
        f"torch {found['torch']} (CUDA {found['torch_cuda']}, NVRTC {found['nvrtc'] or 'missing'}), "
        f"Python {found['python']}, {found['processor']},",
        f"{commit}, {found['date'][:10]}.",
        f"Packages: {packages}. Tools: {tools}.",
    ]


def rows(record: Record) -> Iterator[tuple[str, str, str]]:
    """Yield the rows of the table: the outcome of every piece, and what it measured."""
    for name, entry in record.pieces.items():
        says = entry.says if entry.status == PASSED else f"**{entry.status}**: {entry.says}"
        yield f"{entry.part}: {name}", "", says
        if entry.result:
            yield from details(entry.result)
    yield from fastest(record)


def details(result: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Yield the numbers of one piece; ``result`` is one of those that the pieces write."""
    for row in result.get("rows", []):
        yield f"time of {row['backend']}", scene(row), time_of(row)
    for found in result.get("scenes", []):
        yield "kernels and wall clock", scene(found), wall(found)
        for stage in found["stages"]:
            yield f"stage {stage['stage']}", scene(found), stage_time(stage)
    for found in result.get("sorts", []):
        yield (
            "sort of ours, of torch",
            f"{found['keys']:,} keys of {found['bits']} bits",
            f"{found['ours_ms']:.3f}, {found['torch_ms']:.3f}: {found['torch_ms'] / found['ours_ms']:.2f}x",
        )
    for found in result.get("counters", []):
        numbers = ", ".join(f"{name} {value}" for name, value in found["metrics"].items())
        yield f"counters of {found['kernel']}", "", numbers
    for found in result.get("here", []):
        yield f"step, {found['prior']} prior", f"{found['gaussians']:,.0f} Gaussians", parts_of(found)
    for found in result.get("results", []):
        peak = found["peak_bytes"] or 0
        yield f"recipe {found['recipe']}", f"vram={found['vram']}", recipe_time(found, peak)


def recipe_time(found: dict[str, Any], peak: int) -> str:
    """Return the time of a step of a recipe, of its stages, and the memory."""
    stages = ", ".join(f"{name} {1e3 * seconds:.0f}" for name, seconds in found["stages"].items())
    return f"{1e3 * found['seconds_per_step']:.0f} per step ({stages}); peak {peak / GIB:.1f} GiB, " + (
        f"estimated {found['estimate_bytes'] / GIB:.1f}"
    )


def parts_of(found: dict[str, Any]) -> str:
    """Return the time of a training step and of its parts, which are measured apart."""
    parts = sorted(found["parts_ms"].items(), key=lambda part: -part[1])
    return f"{found['wall_ms']:.2f}; parts " + ", ".join(f"{name} {ms:.2f}" for name, ms in parts)


def scene(row: dict[str, Any]) -> str:
    """Return the scene of a row in words."""
    views = "1 view" if row["views"] == 1 else f"{row['views']} views"
    return f"{row['count']:,} at {row['size']} px, {views}, SH {row['degree']}"


def time_of(row: dict[str, Any]) -> str:
    """Return the times and the memory of a row of ``bench_rasterizer``."""
    if row["step_ms"] is None:
        return "out of memory"
    phases = [f"{phase} {row[f'{phase}_ms']:.2f}" for phase in ("host", "forward", "backward")]
    words = [f"{row['step_ms']:.2f} ({', '.join(phases)})"]
    if row["peak_bytes"] is not None:
        words.append(f"{row['peak_bytes'] / MB:.0f} MB")
    return "; ".join(words)


def wall(found: dict[str, Any]) -> str:
    """Return the sum of all kernels beside the wall clock."""
    busy = found["kernel_ms"] / found["wall_ms"]
    return f"{found['kernel_ms']:.3f} of {found['wall_ms']:.3f}: the GPU is busy {busy:.0%} of the time"


def stage_time(stage: dict[str, Any]) -> str:
    """Return the time of a stage, and what the bytes that it must move would take."""
    text = f"{stage['median_ms']:.3f}"
    if stage["launches"]:
        text += f" in {stage['launches']} launches"
    if stage["floor_ms"]:
        text += (
            f"; {stage['median_ms'] / stage['floor_ms']:.1f}x the time of its {stage['bytes'] / MB:.1f} MB"
        )
    return text


def fastest(record: Record) -> Iterator[tuple[str, str, str]]:
    """Yield which backend was fastest on each scene, and whether ``rasterizer=auto`` uses it."""
    for verdict in verdicts(record):
        text = f"{verdict['fastest']} of {', '.join(verdict['timed'])}; "
        text += f"auto uses {verdict['auto'] or 'an unknown one'}"
        yield (
            "fastest, and choice of `auto`",
            scene(verdict),
            text + (", **which is slower**" if verdict["is_auto_fastest"] is False else ""),
        )


def verdicts(record: Record) -> list[dict[str, Any]]:
    """Return the fastest backend of each timed scene, and whether it is the one that ``auto`` uses."""
    chosen = record.pieces.get("choice of auto")
    auto = (chosen.result or {}).get("backend") if chosen else None
    scenes: dict[tuple[int, ...], list[dict[str, Any]]] = {}
    for entry in record.pieces.values():
        for row in (entry.result or {}).get("rows", []):
            if row["step_ms"] is not None:
                scenes.setdefault((row["count"], row["size"], row["views"], row["degree"]), []).append(row)
    found = []
    for (count, size, views, degree), timed in scenes.items():
        first = min(timed, key=lambda row: row["step_ms"])["backend"]
        found.append(
            {
                "count": count,
                "size": size,
                "views": views,
                "degree": degree,
                "timed": [row["backend"] for row in timed],
                "fastest": first,
                "auto": auto,
                "is_auto_fastest": None if auto is None else auto == first,
            }
        )
    return found


def table(header: Sequence[str], body: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a table."""
    lines = [header, ["---"] * len(header), *body]
    # A message of a compiler has several lines, and a cell has one.
    return [
        "| " + " | ".join(" ".join(cell.split()).replace("|", "\\|") for cell in line) + " |"
        for line in lines
    ]
