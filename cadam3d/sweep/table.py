"""Table: write ``sweep.csv``, with one row per job, from the files on disk."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cadam3d.io.atomic import replacing
from cadam3d.io.jsonl import to_json
from cadam3d.io.records import Score, declared, difference, psnr_of, read_scores
from cadam3d.io.run_folder import TABLE, shown
from cadam3d.settings.line import setting_word
from cadam3d.sweep.folder import Row, load

FACTS = ("num_gaussians", "num_gaussians_initial", "psnr", "ssim", "seconds", "asset_bytes", "message")
BRIEF = 80  # characters
# Columns that only jobs with a prompt of a file or a set have.
LABELS = ("prompt_name", "category")
# Columns of the table in the terminal, besides the outcome and the settings in which jobs differ.
SHOWN = ("num_gaussians", "psnr", "seconds")


@dataclass(frozen=True)
class Scores:
    """The scores of jobs that may be in one table, because each was measured in one way."""

    columns: Mapping[str, Sequence[float | None]]  # one value per job, by the name of the number
    left_out: Sequence[str]  # a sentence about each number that was measured in different ways


def write_table(sweep: Path) -> list[Row]:
    """Write the table of a sweep atomically, and return its rows.

    Jobs that run side by side all write it. Each reads the disk again afterwards, so the last one to write
    has seen every job that ended before.
    """
    rows = load(sweep)
    while True:
        _write(sweep / TABLE, rows)
        written, rows = rows, load(sweep)
        if rows == written:
            return rows


def as_text(rows: Sequence[Row]) -> str:
    """Return a table for the terminal, without settings that are the same in all jobs of an arm.

    Sentences below it say which scores it leaves out.
    """
    keys = varying_keys(rows)
    has_arms = any(row.arm for row in rows)
    scores = _scores(rows)
    lines: list[list[Any]] = [
        ["job", *(["arm"] if has_arms else []), *keys, "outcome", *SHOWN, *scores.columns]
    ]
    for index, row in enumerate(rows):
        values = [row.number, *([row.arm] if has_arms else []), *(brief(row.swept.get(key)) for key in keys)]
        shown = row.summary | {"psnr": psnr_of(row.summary)}
        facts = [row.outcome, *(shown.get(name) for name in SHOWN)]
        lines.append([*values, *facts, *(column[index] for column in scores.columns.values())])
    return "\n".join([aligned(lines), *scores.left_out])


def scores_of(jobs: Sequence[Mapping[str, Score]], sweep: Path) -> Scores:
    """Return the scores of the jobs of a sweep, by name for each job, as columns. Missing ones are None.

    A number that was measured in different ways (with different protocols, models or lists of prompts) is
    left out.
    """
    columns: dict[str, list[float | None]] = {}
    left_out = []
    for name in dict.fromkeys(name for job in jobs for name in job):
        found = [job.get(name) for job in jobs]
        problem = difference(name, [score for score in found if score is not None])
        if problem is None:
            columns[name] = [None if score is None else score.value for score in found]
        else:
            metric = next(score.metric for score in found if score is not None) or name
            again = f"cadam3d eval {setting_word('run', shown(sweep))} 'metric=[{metric}]'"
            left_out.append(f"{problem}, so it is not in the table. Try: {again}")
    return Scores(columns, left_out)


def aligned(lines: Sequence[Sequence[Any]]) -> str:
    """Return lines of equally many values as text, in columns."""
    texts = [[_cell(value) for value in line] for line in lines]
    widths = [max(map(len, column)) for column in zip(*texts, strict=True)]
    padded = [[cell.ljust(width) for cell, width in zip(line, widths, strict=True)] for line in texts]
    return "\n".join("  ".join(line).rstrip() for line in padded)


def _scores(rows: Sequence[Row]) -> Scores:
    folder = rows[0].folder.parent if rows else Path()
    return scores_of([read_scores(row.folder, row.summary) for row in rows], folder)


def brief(value: Any) -> str:
    """Return a value on one line of at most ``BRIEF`` characters, for a column or a sentence."""
    text = " ".join(_cell(value).split())
    return text if len(text) <= BRIEF else f"{text[: BRIEF - 3]}..."


def varying_keys(rows: Sequence[Row]) -> list[str]:
    """Return the keys in which jobs of the same arm differ."""
    arms = len({row.arm for row in rows})
    return [
        key
        for key in _swept_keys(rows)
        if len({(row.arm, to_json(row.swept.get(key))) for row in rows}) > arms
    ]


def _write(path: Path, rows: Sequence[Row]) -> None:
    keys = _swept_keys(rows)
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        names = [*FACTS, *_comparisons(rows)]
        labels = [name for name in LABELS if any(getattr(row, name) for row in rows)]
        scores = _scores(rows).columns
        writer.writerow(["job", "arm", *labels, *keys, "outcome", *names, *scores, "folder"])
        for index, row in enumerate(rows):
            said = [getattr(row, name) for name in labels]
            swept = [_plain(row.swept.get(key)) for key in keys]
            facts = [row.summary.get(name) for name in names]
            facts += [column[index] for column in scores.values()]
            writer.writerow([row.number, row.arm, *said, *swept, row.outcome, *facts, row.folder.name])


def _comparisons(rows: Sequence[Row]) -> list[str]:
    """Return the numbers that compare an asset with the truth, without those in ``FACTS``."""
    known = {name: number for row in rows for name, number in declared(row.summary).items()}
    return [name for name, number in known.items() if number.needs_truth and name not in FACTS]


def _swept_keys(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(key for row in rows for key in row.swept))


def _plain(value: Any) -> Any:
    return value if value is None or isinstance(value, str | int | float) else to_json(value)


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(_plain(value))
