"""Table: write ``sweep.csv``, with one row per job, from the files on disk."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cadam3d.io.jsonl import to_json
from cadam3d.io.records import declared, difference, psnr_of, read_scores
from cadam3d.io.run_folder import TABLE
from cadam3d.io.text_tables import write_csv
from cadam3d.sweep.folder import Row, load

FACTS = (
    *("num_gaussians", "num_gaussians_initial", "psnr", "ssim", "seconds", "cpu_seconds", "asset_bytes"),
    *("commit", "machine", "threads", "message"),
)
BRIEF = 80  # characters
# Columns that only jobs with a prompt of a file or a set have.
LABELS = ("prompt_name", "category")
# Columns of the table in the terminal, besides the outcome and the settings in which jobs differ.
SHOWN = ("num_gaussians", "psnr", "seconds")


def write_table(sweep: Path) -> list[Row]:
    """Write the table of a sweep atomically, and return its rows.

    Jobs that run side by side all write it. Each reads the disk again afterwards, so the last one to write
    has seen every job that ended before.
    """
    rows = load(sweep)
    while True:
        columns = columns_of(rows)
        write_csv(sweep / TABLE, [columns, *zip(*columns.values(), strict=True)])
        written, rows = rows, load(sweep)
        if rows == written:
            return rows


def as_text(rows: Sequence[Row]) -> str:
    """Return a table for the terminal, without settings that are the same in all jobs of an arm.

    Sentences below it say which scores it leaves out.
    """
    scores, left_out = _scores(rows)
    facts = [row.summary | {"psnr": psnr_of(row.summary), "outcome": row.outcome} for row in rows]
    columns = {name: [each.get(name) for each in facts] for name in ("outcome", *SHOWN)}
    return "\n".join([_table(rows, {**columns, **scores}), *left_out])


def listing(rows: Sequence[Row]) -> str:
    """Return a table of the jobs: arm, settings in which they differ, what is to be done, and folder."""
    states = [
        row.outcome if row.has_result else "to continue" if row.has_checkpoint else "to run" for row in rows
    ]
    return _table(rows, {"state": states, "folder": [row.name for row in rows]})


def _table(rows: Sequence[Row], columns: Mapping[str, Sequence[Any]]) -> str:
    """Return a table that begins with the number, the arm and the settings of each job."""
    swept = {key: [brief(row.swept.get(key)) for row in rows] for key in varying_keys(rows)}
    whole = {"job": [row.number for row in rows], "arm": [row.arm for row in rows], **swept, **columns}
    return aligned([list(whole), *zip(*whole.values(), strict=True)])


def _scores(rows: Sequence[Row]) -> tuple[dict[str, list[float | None]], list[str]]:
    """Return the scores of the jobs as columns, by name, and a sentence about each that is left out.

    A number that was measured in different ways (with different protocols, models or lists of prompts) is
    left out.
    """
    jobs = [read_scores(row.folder, row.summary) for row in rows]
    columns, left_out = {}, []
    for name in dict.fromkeys(name for job in jobs for name in job):
        if problem := difference(name, [job[name] for job in jobs if name in job]):
            left_out.append(f"{problem}, so it is not in the table. Try: cadam3d eval --help")
        else:
            columns[name] = [job[name].value if name in job else None for job in jobs]
    return columns, left_out


def aligned(lines: Sequence[Sequence[Any]]) -> str:
    """Return lines of equally many values as text, in columns."""
    texts = [[_cell(value) for value in line] for line in lines]
    widths = [max(map(len, column)) for column in zip(*texts, strict=True)]
    padded = [[cell.ljust(width) for cell, width in zip(line, widths, strict=True)] for line in texts]
    return "\n".join("  ".join(line).rstrip() for line in padded)


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


def records_of(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the table as one dict per job."""
    columns = columns_of(rows)
    return [dict(zip(columns, line, strict=True)) for line in zip(*columns.values(), strict=True)]


def columns_of(rows: Sequence[Row]) -> dict[str, Sequence[Any]]:
    """Return the columns of the table: arm, settings, outcome, numbers and folder of each job."""
    labels = {name: [getattr(row, name) for row in rows] for name in LABELS}
    return {
        "job": [row.number for row in rows],
        "arm": [row.arm for row in rows],
        **{name: values for name, values in labels.items() if any(values)},
        **{key: [_plain(row.swept.get(key)) for row in rows] for key in _swept_keys(rows)},
        "outcome": [row.outcome for row in rows],
        **{name: [row.summary.get(name) for row in rows] for name in (*FACTS, *_comparisons(rows))},
        **_scores(rows)[0],
        "folder": [row.name for row in rows],
    }


def _comparisons(rows: Sequence[Row]) -> list[str]:
    """Return the numbers of the assets that metrics declare and that have a better direction."""
    known = {name: number for row in rows for name, number in declared(row.summary).items()}
    return [name for name, number in known.items() if number.is_more_better is not None and name not in FACTS]


def _swept_keys(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(key for row in rows for key in row.swept))


def _plain(value: Any) -> Any:
    return value if value is None or isinstance(value, str | int | float) else to_json(value)


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(_plain(value))
