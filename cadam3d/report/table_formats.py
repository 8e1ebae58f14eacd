"""Formats of the paper's table: Markdown, CSV and LaTeX, which show the same text in every cell."""

import csv
import io
from collections.abc import Sequence

from cadam3d.report.paper_table import PaperTable, Section, TableCell, TableRow

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
    arrows = [ARROWS[number.is_more_better] for number in table.numbers]
    return [
        *FIRST,
        *(f"{title} {arrow}".strip() for title, arrow in zip(table.headings, arrows, strict=True)),
    ]


def texts(row: TableRow, names: Sequence[str]) -> list[str]:
    """Return the text of every cell of a row, for readers."""
    return [
        row.objective,
        row.method,
        row.source,
        row.prompts,
        *(text(row.cells[name], row) for name in names),
    ]


def text(cell: TableCell, row: TableRow) -> str:
    """Return the text of a number with its interval, and how many prompts it has if other than its row."""
    interval = f" ± {cell.shown_half}" if cell.half else ""
    is_other = cell.prompts is not None and str(cell.prompts) != row.prompts.partition(" ")[0]
    return f"{cell.value}{interval}{f' ({cell.prompts})' if is_other else ''}"


def markdown(table: PaperTable) -> str:
    """Return the table as Markdown, one part for all prompts and one for each category."""
    lines = []
    for section in table.sections:
        if len(table.sections) > 1:
            lines += [f"**{_in_markdown(section.category or ALL)}**", ""]
        lines += [_markdown_line(headings(table))]
        lines += [_markdown_line([*["---"] * len(FIRST), *["---:"] * len(table.names)])]
        lines += [_markdown_line(texts(row, table.names)) for row in section.rows] + [""]
    return "\n".join([*lines, *(f"- {' '.join(note.split())}" for note in table.notes)]) + "\n"


def comma_separated(table: PaperTable) -> str:
    """Return the table as CSV: each number with half the width of its interval and its count of prompts."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    columns = [column for title in table.headings for column in (title, f"{title}: ±", f"{title}: prompts")]
    writer.writerow(["category", *FIRST, *columns])
    for section in table.sections:
        for row in section.rows:
            cells = [row.cells[name] for name in table.names]
            numbers = [entry for cell in cells for entry in (cell.text, cell.half, cell.prompts)]
            writer.writerow(
                [section.category or ALL, row.objective, row.method, row.source, row.prompts, *numbers]
            )
    return file.getvalue()


def latex(table: PaperTable) -> str:
    """Return the table as LaTeX that needs no package; the parts follow each other in one file."""
    parts = [_latex_section(table, section) for section in table.sections]
    notes = "\n".join(f"% {' '.join(note.split())}" for note in table.notes)
    return "\n".join([*parts, notes]) + "\n"


def _latex_section(table: PaperTable, section: Section) -> str:
    lines = [r"\begin{table}", r"\centering"]
    lines += [rf"\caption{{{in_latex(section.category or ALL)}}}"]
    lines += [rf"\begin{{tabular}}{{{'l' * len(FIRST)}{'r' * len(table.names)}}}", r"\hline"]
    lines += [_latex_line(headings(table)), r"\hline"]
    for position, row in enumerate(section.rows):
        if position and row.objective != section.rows[position - 1].objective:
            lines.append(r"\hline")
        lines.append(_latex_line(texts(row, table.names)))
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
