"""Draw the tables and figures of the docs from the rows of docs/data, and collect these rows from sweeps.

    python scripts/make_tables.py collect multirun/objects docs/data/objects.csv
    python scripts/make_tables.py

The first line writes a row for each finished job. The second line writes every table between the lines
``<!-- table: NAME -->`` and ``<!-- end -->`` of a page, and every figure into docs/images.
``docs/data/tables.yaml`` declares them. A figure is drawn again if its rows or its declaration have changed.
"""

import csv
import json
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from statistics import median
from typing import Any

import measuring
from PIL import Image

from cadam3d.core.errors import UserError
from cadam3d.core.number import COUNT
from cadam3d.io.reading import read_yaml
from cadam3d.io.text_tables import write_csv
from cadam3d.metric.fidelity import Fidelity
from cadam3d.report.compare import (
    above_frontier,
    arms_without_growth,
    by_cell,
    clock,
    compare,
    hull_of,
    main_setting,
    qualities,
    quality_at,
    settings_of,
    value_of,
)
from cadam3d.report.estimate import Estimate
from cadam3d.report.figures import frontier_figure
from cadam3d.report.results import PREFIX, ArmSetting, JobResult, arms_of, read, results_of
from cadam3d.report.style import styled
from cadam3d.sweep.folder import Row

NUMBERS = {each.name: each for each in Fidelity.numbers if each.name.startswith(("psnr", "ssim"))}
# The columns of a row beside the settings: entries of summary.json.
BEFORE = ("prompt", "seed", "arm", "densifier")
RESULTS = ("outcome", "grows", COUNT.name, "psnr", "ssim", "psnr_turned", "ssim_turned")
AFTER = (*RESULTS, "seconds", "cpu_seconds", "commit", "machine", "threads")
TEXTS = ("prompt", "arm", "commit", "machine")  # also those that look like numbers, such as 12345e7
MARKED = re.compile(r"(<!-- table: (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)
MISSING = "*Not measured yet.*"

Line = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """A table or a figure, as ``tables.yaml`` declares it. An arm also stands for its main setting."""

    data: str  # the name of a file in docs/data, without its suffix
    kind: str  # a key of TABLES, or "figure", which is the frontier of each arm
    where: Mapping[str, list] = field(default_factory=dict)  # the values of some columns in the rows to use
    by: Sequence[str] = ()  # columns, such as noise; each combination of their values has its own lines
    arms: Sequence[str] = ()  # arms or settings to show; empty = all settings
    pairs: Sequence[Sequence[str]] = ()  # of arms or settings
    against: str = ""  # the arm or setting with which others are compared; empty = the arm without growth
    frontier: str = ""  # the arm with whose best setting at equal count settings are compared
    columns: str = ""  # of a pivot table: the column whose values are the titles
    cell: str = ""  # of a pivot table: the format of a cell
    alt: str = ""  # of a figure: what it shows, for people who cannot see it


# --- rows -------------------------------------------------------------------------------------------------


def collect(sweep: Path, file: Path) -> str:
    """Write the rows of the finished jobs of a sweep, and return a sentence about them."""
    results = [each for each in read(sweep) if each.has_result]
    keys = dict.fromkeys(key for each in results for key in each.swept if key not in BEFORE)
    kept = [key for key in keys if key.startswith(PREFIX) or _differs(results, key)]
    columns = [*BEFORE, *kept, *AFTER]
    lines = [_line_of(each, columns) for each in results]
    columns = [key for key in columns if any(line[key] is not None for line in lines) or key in AFTER[-5:]]
    file.parent.mkdir(parents=True, exist_ok=True)
    write_csv(file, [columns, *([line[key] for key in columns] for line in lines)])
    commits = ", ".join(sorted({str(line.get("commit")) for line in lines}))
    return f"{file}: {len(lines)} finished jobs, commit {commits}"


def _differs(results: Iterable[JobResult], key: str) -> bool:
    return len({repr(each.swept.get(key)) for each in results}) > 1


def _line_of(result: JobResult, columns: Iterable[str]) -> Line:
    numbers = {
        name: round(value, NUMBERS[name].digits + 4)
        for name, value in result.numbers.items()
        if name in NUMBERS
    }
    found = {**result.summary, **dict.fromkeys(NUMBERS), **result.swept, **numbers, "arm": result.arm}
    return {key: found.get(key) for key in columns}


def read_lines(file: Path) -> list[Line]:
    """Return the rows of a file, without empty cells."""
    with file.open(encoding="utf-8", newline="") as opened:
        return [
            {key: text if key in TEXTS else _value(text) for key, text in line.items() if text != ""}
            for line in csv.DictReader(opened)
        ]


def _value(text: str) -> Any:
    try:
        return json.loads(text.replace("True", "true").replace("False", "false"))
    except ValueError:
        return text


def with_results(lines: Sequence[Line]) -> list[Line]:
    """Return rows of a sweep, with what a report reads from its folder and the name of its setting."""
    rows = [
        Row(
            arm=str(line["arm"]),
            name="",
            overrides=[],
            swept={key: value for key, value in line.items() if key not in (*AFTER, "arm")},
            number=i,
            folder=Path("none"),
            summary={**line, "numbers": {name: each.declaration() for name, each in NUMBERS.items()}},
        )
        for i, line in enumerate(lines)
    ]
    found = zip(lines, results_of(rows), strict=True)
    return [{**line, "result": result, "setting": f"`{result.setting.name}`"} for line, result in found]


# --- tables -----------------------------------------------------------------------------------------------


def settings_table(drawing: Drawing, lines: Sequence[Line]) -> list[Line]:
    """Return medians of each setting, its gain over another one, and its gain over a frontier."""
    found = []
    for where, own in groups(lines, drawing.by):
        here = [line["result"] for line in own]
        quality, against = qualities(here)[0], drawing.against or next(iter(arms_without_growth(here)), "")
        zero = _chosen(here, [against])[0] if against else None
        for setting in _chosen(here, drawing.arms):
            members = list(by_cell(here, setting).values())
            early = sum(each.ended_early for each in members)
            line: Line = {**where, "setting": f"`{setting.name}`"}
            line["cells"] = f"{len(members)}" + f" ({early} ended early)" * bool(early)
            line["Gaussians"] = f"{median(each.count for each in members):,.0f}"
            line[quality.heading] = _median(map(value_of(quality), members), quality.digits)
            if zero is not None:
                pair = compare(here, setting, zero) if setting != zero else None
                gain = pair and pair.difference(value_of(quality))
                line[f"over `{zero.name}` (dB)"] = _written(gain, quality.digits)
            if drawing.frontier:
                above = above_frontier(here, setting, drawing.frontier, value_of(quality))
                gain = Estimate.of(above) if above and setting.arm != drawing.frontier else None
                line[f"over the frontier of `{drawing.frontier}` (dB)"] = _written(gain, quality.digits)
            heading, seconds = clock(here)
            line[heading] = _median(map(seconds, members), 0)
            found.append(line)
    return found


def pairs_table(drawing: Drawing, lines: Sequence[Line]) -> list[Line]:
    """Return the paired differences of the declared pairs, the first setting minus the second."""
    found = []
    for where, own in groups(lines, drawing.by):
        here = [line["result"] for line in own]
        quality = qualities(here)[0]
        for pair in (compare(here, *_chosen(here, names)) for names in drawing.pairs):
            if pair is not None:
                names = {"setting": f"`{pair.ours.name}`", "minus": f"`{pair.theirs.name}`"}
                line: Line = {**where, **names, "cells": len(pair.pairs)}
                line["Gaussians (%)"] = _written(pair.count, 1)
                line[quality.heading] = _written(pair.difference(value_of(quality)), quality.digits)
                heading, seconds = clock(here)
                line[heading] = _written(pair.difference(seconds), 0)
                found.append(line)
    return found


def pivot_table(drawing: Drawing, lines: Sequence[Line]) -> list[Line]:
    """Return a table of medians over rows, with a line for each group and a column for each title."""
    if drawing.arms:
        chosen = _chosen([line["result"] for line in lines], drawing.arms)
        lines = [line for line in lines if line["result"].setting in chosen]
    if drawing.frontier:
        lines = list(_with_above(lines, drawing.frontier))
    return [
        where | {at[drawing.columns]: _cell(drawing.cell, own) for at, own in groups(here, [drawing.columns])}
        for where, here in groups(lines, drawing.by)
    ]


def _with_above(lines: Sequence[Line], strategy: str) -> Iterator[Line]:
    """Yield rows of fits with ``above``, the dB above the best settings of a strategy at equal count.

    It is "outside" for a count that no setting of the strategy has below or above it.
    """
    for _, own in groups(lines, ["object", "seed"]):
        hull = hull_of((line["count"], line["psnr"]) for line in own if line["strategy"] == strategy)
        for line in own:
            best = quality_at(hull, line["count"])
            yield {**line, "above": "outside" if best is None else f"{line['psnr'] - best:+.2f}"}


def rows_table(drawing: Drawing, lines: Sequence[Line]) -> list[Line]:
    """Return the rows as they are, with the columns ``by``, or all."""
    return [{key: line.get(key, "") for key in drawing.by or line} for line in lines]


Table = Callable[[Drawing, Sequence[Line]], list[Line]]
TABLES: dict[str, Table] = {
    "settings": settings_table,
    "pairs": pairs_table,
    "pivot": pivot_table,
    "rows": rows_table,
}


def groups(lines: Sequence[Line], keys: Sequence[str]) -> Iterator[tuple[Line, list[Line]]]:
    """Yield each combination of values of some columns with its rows, in the order of the rows."""
    found: dict[tuple, list[Line]] = {}
    keys = [key for key in keys if any(key in line for line in lines)]
    for line in lines:
        found.setdefault(tuple(line.get(key, "") for key in keys), []).append(line)
    for values, own in found.items():
        yield dict(zip(keys, values, strict=True)), own


def _chosen(results: Sequence[JobResult], names: Sequence[str]) -> list[ArmSetting]:
    """Return the settings with these names, where an arm stands for its main setting; without names all."""
    known = {each.name: each for arm in arms_of(results) for each in settings_of(results, arm)}
    if wrong := [name for name in names if name not in (*known, *arms_of(results))]:
        raise UserError(f"tables.yaml: expected arms or settings of {', '.join(known)}, got {wrong[0]}")
    return [known.get(name) or main_setting(results, name) for name in names] or list(known.values())


def _cell(form: str, lines: Sequence[Line]) -> str:
    """Return a format filled with medians of numbers and texts of the first row; a dash if one is missing."""
    first = lines[0]
    numbers = [key for key, value in first.items() if type(value) in (int, float)]
    medians = {key: median(line[key] for line in lines if key in line) for key in numbers}
    try:
        return form.format(**{**first, **medians})
    except KeyError:
        return "-"


def _median(values: Iterable[float | None], digits: int) -> str:
    known = [value for value in values if value is not None]
    return f"{median(known):,.{digits}f}" if known else "-"


def _written(estimate: Estimate | None, digits: int) -> str:
    return "-" if estimate is None else estimate.written(digits)


# --- pages ------------------------------------------------------------------------------------------------


def draw_all(root: Path) -> None:
    """Write all tables and figures of the docs in the folder ``root``.

    Raises ``UserError`` for a name that a page marks and ``tables.yaml`` lacks, or the other way round.
    """
    data = root / "docs" / "data"
    drawings = {name: Drawing(**entry) for name, entry in read_yaml(data / "tables.yaml").items()}
    pages = [root / "README.md", *sorted((root / "docs").rglob("*.md"))]
    texts = {page: page.read_text(encoding="utf-8") for page in pages}
    marked = {name for text in texts.values() for _, name, _ in MARKED.findall(text)}
    if wrong := marked ^ set(drawings):
        expected = "every name in tables.yaml and between marks of a page"
        raise UserError(f"{data}: expected {expected}, got only one of both for {', '.join(sorted(wrong))}")
    for page, text in texts.items():
        new = MARKED.sub(
            lambda found, page=page: (
                f"{found[1]}\n{text_of(found[2], drawings[found[2]], data, page)}\n\n{found[3]}"
            ),
            text,
        )
        if new != text:
            page.write_text(new, encoding="utf-8")


def text_of(name: str, drawing: Drawing, data: Path, page: Path) -> str:
    """Return a table in Markdown, or draw a figure and return its link from a page."""
    lines = lines_of(drawing, data)
    if not lines:
        return MISSING
    if drawing.kind == "figure":
        path = data.parent / "images" / f"{name}.png"
        draw_figure(drawing, lines, path)
        return f"![{drawing.alt}]({os.path.relpath(path, page.parent)})"
    return measuring.table(TABLES[drawing.kind](drawing, lines))


def lines_of(drawing: Drawing, data: Path) -> list[Line]:
    """Return the rows that a drawing uses, with their results if they are those of a sweep."""
    file = data / f"{drawing.data}.csv"
    lines = [
        line
        for line in (read_lines(file) if file.exists() else ())
        if all(line.get(key) in values for key, values in drawing.where.items())
    ]
    return with_results(lines) if lines and "arm" in lines[0] else lines


def draw_figure(drawing: Drawing, lines: Sequence[Line], path: Path) -> None:
    """Draw the frontiers of the arms, unless the picture says that it was drawn from the same rows."""
    plain = [{key: value for key, value in line.items() if key != "result"} for line in lines]
    source = sha256(repr((drawing, plain)).encode()).hexdigest()
    if path.exists():
        with Image.open(path) as drawn:
            if drawn.info.get("Source") == source:
                return
    with styled():
        figure = frontier_figure([line["result"] for line in lines])
        assert figure is not None
        figure.savefig(path, dpi=160, metadata={"Source": source})


def main(words: Sequence[str] | None = None) -> None:
    """Collect rows, or draw everything."""
    parser = measuring.parser_of(__doc__)
    commands = parser.add_subparsers(dest="command")
    collecting = commands.add_parser("collect", help="write the rows of a sweep")
    collecting.add_argument("sweep", type=Path, help="folder of the sweep")
    collecting.add_argument("file", type=Path, help="such as docs/data/objects.csv")
    args = parser.parse_args(words)
    try:
        if args.command:
            print(collect(args.sweep, args.file))
        else:
            draw_all(measuring.HERE)
    except UserError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
