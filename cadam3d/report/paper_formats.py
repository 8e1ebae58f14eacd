"""Formats of the paper's table: Markdown, CSV and LaTeX, which show the same text in every cell."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from cadam3d.io.atomic import replacing
from cadam3d.io.run_folder import PAPER_TABLE_CSV, PAPER_TABLE_LATEX, PAPER_TABLE_MARKDOWN
from cadam3d.report.paper_table import PaperTable, TableCell, TablePart, TableRow, paper_table
from cadam3d.report.results import read
from cadam3d.sweep.folder import read_plan

FIRST = ("objective", "method", "source", "prompts")
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


def texts(row: TableRow) -> list[str]:
    """Return the text of every cell of a row, for readers."""
    return [row.objective, row.method, row.source, row.prompts, *(text(cell, row) for cell in row.cells)]


def text(cell: TableCell, row: TableRow) -> str:
    """Return the text of a number with its interval, and how many prompts it has if other than its row."""
    interval = f" ± {cell.shown_half}" if cell.half else ""
    is_other = cell.prompts is not None and str(cell.prompts) != row.prompts.partition(" ")[0]
    return f"{cell.value}{interval}{f' ({cell.prompts})' if is_other else ''}"


def markdown(table: PaperTable) -> str:
    """Return the table as Markdown, one part for all prompts and one for each category."""
    lines = []
    for part in table.parts:
        if len(table.parts) > 1:
            lines += [f"**{_in_markdown(part.category or ALL)}**", ""]
        lines += [_markdown_line(headings(table))]
        lines += [_markdown_line([*["---"] * len(FIRST), *["---:"] * len(table.numbers)])]
        lines += [_markdown_line(texts(row)) for row in part.rows] + [""]
    return "\n".join([*lines, *(f"- {' '.join(note.split())}" for note in table.notes)]) + "\n"


def comma_separated(table: PaperTable) -> str:
    """Return the table as CSV: each number with half the width of its interval and its count of prompts."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    titles = [number.heading for number in table.numbers]
    columns = [column for title in titles for column in (title, f"{title}: ±", f"{title}: prompts")]
    writer.writerow(["category", *FIRST, *columns])
    for part in table.parts:
        for row in part.rows:
            numbers = [entry for cell in row.cells for entry in (cell.text, cell.half, cell.prompts)]
            writer.writerow(
                [part.category or ALL, row.objective, row.method, row.source, row.prompts, *numbers]
            )
    return file.getvalue()


def latex(table: PaperTable) -> str:
    """Return the table as LaTeX that needs no package; the parts follow each other in one file."""
    parts = [_latex_part(table, part) for part in table.parts]
    notes = "\n".join(f"% {' '.join(note.split())}" for note in table.notes)
    return "\n".join([*parts, notes]) + "\n"


def _latex_part(table: PaperTable, part: TablePart) -> str:
    lines = [r"\begin{table}", r"\centering"]
    lines += [rf"\caption{{{in_latex(part.category or ALL)}}}"]
    lines += [rf"\begin{{tabular}}{{{'l' * len(FIRST)}{'r' * len(table.numbers)}}}", r"\hline"]
    lines += [_latex_line(headings(table)), r"\hline"]
    for position, row in enumerate(part.rows):
        if position and row.objective != part.rows[position - 1].objective:
            lines.append(r"\hline")
        lines.append(_latex_line(texts(row)))
    return "\n".join([*lines, r"\hline", r"\end{tabular}", r"\end{table}", ""])


def in_latex(plain: str) -> str:
    """Return a text in which no character has a meaning in LaTeX."""
    return "".join(LATEX.get(character, character) for character in " ".join(plain.split()))


def _latex_line(cells: Sequence[str]) -> str:
    return " & ".join(map(in_latex, cells)) + r" \\"


def _markdown_line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cell if set(cell) <= set('-:') else _in_markdown(cell) for cell in cells)} |"


def _in_markdown(plain: str) -> str:
    line = " ".join(plain.split())
    return "".join(f"\\{character}" if character in r"\|*_`<[" else character for character in line)


FORMATS = {PAPER_TABLE_MARKDOWN: markdown, PAPER_TABLE_CSV: comma_separated, PAPER_TABLE_LATEX: latex}


def read_table(sweep: Path) -> PaperTable | None:
    """Return the table of a sweep; None if its grid does not ask for it or no job has left an asset."""
    return paper_table(read(sweep), sweep) if read_plan(sweep).paper_table else None


def write(sweep: Path) -> str:
    """Write the table in all formats, and return it as Markdown; "" if there is none.

    Raises ``UserError`` if a file cannot be written.
    """
    table = read_table(sweep)
    if table is None:
        # Files that an earlier line wrote would be mistaken for the table of the present jobs.
        for name in FORMATS:
            (sweep / name).unlink(missing_ok=True)
        return ""
    for name, write_as in FORMATS.items():
        with replacing(sweep / name) as temporary:
            temporary.write_text(write_as(table), encoding="utf-8")
    return markdown(table)
