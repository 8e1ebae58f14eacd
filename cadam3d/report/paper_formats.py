"""Formats of the paper's table: Markdown, CSV and LaTeX, which show the same text in every cell."""

import csv
import io
import re
from collections.abc import Sequence
from pathlib import Path

from cadam3d.io.atomic import replacing
from cadam3d.io.run_folder import PAPER_TABLE_CSV, PAPER_TABLE_LATEX, PAPER_TABLE_MARKDOWN
from cadam3d.report.paper_table import PaperTable, TableCell, TableRow, paper_table
from cadam3d.report.results import read
from cadam3d.sweep.folder import read_plan

FIRST = ("category", "objective", "method", "source", "prompts")
ALL = "all prompts"
ARROWS = {True: "↑", False: "↓", None: ""}
# Characters with a meaning in LaTeX, or that its fonts lack.
LATEX = {
    "\\": r"\textbackslash{}",
    "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': r"\textquotedbl{}",
    "±": r"$\pm$",
    "↑": r"$\uparrow$",
    "↓": r"$\downarrow$",
    **{character: f"\\{character}" for character in "&%$#_{}"},
}


def headings(table: PaperTable) -> list[str]:
    """Return the titles of all columns, with an arrow towards the better numbers."""
    return [*FIRST, *(f"{each.heading} {ARROWS[each.is_more_better]}".strip() for each in table.numbers)]


def texts(table: PaperTable) -> list[list[str]]:
    """Return the text of every cell of every row, for readers."""
    return [[*_beginning(row), *(text(cell, row) for cell in row.cells)] for row in table.rows]


def _beginning(row: TableRow) -> tuple[str, ...]:
    return row.category or ALL, row.objective, row.method, row.source, row.prompts


def text(cell: TableCell, row: TableRow) -> str:
    """Return the text of a number with its interval, and how many prompts it has if other than its row."""
    interval = f" ± {cell.half}" if cell.half else ""
    is_other = cell.prompts is not None and str(cell.prompts) != row.prompts.partition(" ")[0]
    return f"{cell.text}{interval}{f' ({cell.prompts})' if is_other else ''}"


def markdown(table: PaperTable) -> str:
    """Return the table as Markdown, with its notes as a list."""
    rule = [*["---"] * len(FIRST), *["---:"] * len(table.numbers)]
    rows = [_markdown_line(headings(table)), f"| {' | '.join(rule)} |", *map(_markdown_line, texts(table))]
    return "\n".join([*rows, "", *(f"- {note}" for note in table.notes)]) + "\n"


def _markdown_line(cells: Sequence[str]) -> str:
    escaped = (re.sub(r"([\\|*_`<\[])", r"\\\1", " ".join(cell.split())) for cell in cells)
    return f"| {' | '.join(escaped)} |"


def comma_separated(table: PaperTable) -> str:
    """Return the table as CSV: each number with half the width of its interval and its count of prompts."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    titles = [number.heading for number in table.numbers]
    writer.writerow(
        [*FIRST, *(each for title in titles for each in (title, f"{title}: ±", f"{title}: prompts"))]
    )
    for row in table.rows:
        numbers = [
            entry
            for cell in row.cells
            for entry in (cell.text.replace(",", ""), cell.half.replace(",", ""), cell.prompts)
        ]
        writer.writerow([*_beginning(row), *numbers])
    return file.getvalue()


def latex(table: PaperTable) -> str:
    """Return the table as LaTeX that needs no package, with a line above each objective."""
    lines = [r"\begin{table}", r"\centering"]
    lines += [rf"\begin{{tabular}}{{{'l' * len(FIRST)}{'r' * len(table.numbers)}}}", r"\hline"]
    lines += [_latex_line(headings(table))]
    before = None
    for row, cells in zip(table.rows, texts(table), strict=True):
        lines += [r"\hline"] if before != (row.category, row.objective) else []
        before = (row.category, row.objective)
        lines.append(_latex_line(cells))
    notes = [f"% {note}" for note in table.notes]
    return "\n".join([*lines, r"\hline", r"\end{tabular}", r"\end{table}", *notes]) + "\n"


def in_latex(plain: str) -> str:
    """Return a text in which no character has a meaning in LaTeX."""
    return " ".join(plain.split()).translate(str.maketrans(LATEX))


def _latex_line(cells: Sequence[str]) -> str:
    return " & ".join(map(in_latex, cells)) + r" \\"


FORMATS = {PAPER_TABLE_MARKDOWN: markdown, PAPER_TABLE_CSV: comma_separated, PAPER_TABLE_LATEX: latex}


def read_table(sweep: Path) -> PaperTable | None:
    """Return the table of a sweep; None if its grid does not ask for it or no job has left an asset."""
    return paper_table(read(sweep)) if read_plan(sweep).paper_table else None


def write(sweep: Path) -> str:
    """Write the table in all formats, and return it as Markdown; "" if there is none.

    Files of an earlier line that asked for the table are removed then. Raises ``UserError`` if a file cannot
    be written.
    """
    table = read_table(sweep)
    if table is None:
        for name in FORMATS:
            (sweep / name).unlink(missing_ok=True)
        return ""
    for name, write_as in FORMATS.items():
        with replacing(sweep / name) as temporary:
            temporary.write_text(write_as(table), encoding="utf-8")
    return markdown(table)
