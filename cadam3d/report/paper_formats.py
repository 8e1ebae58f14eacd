"""Formats of the paper's table: Markdown, CSV and LaTeX, which show the same text in every cell."""

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from cadam3d.io import text_tables
from cadam3d.io.atomic import replacing
from cadam3d.io.run_folder import PAPER_TABLE_CSV, PAPER_TABLE_LATEX, PAPER_TABLE_MARKDOWN
from cadam3d.report.paper_table import FIRST, PaperTable, paper_table
from cadam3d.report.results import read
from cadam3d.sweep.folder import read_plan

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


def markdown(table: PaperTable) -> str:
    """Return the table as Markdown, with its notes as a list."""
    rows = text_tables.markdown([table.titles, *table.lines], table.is_text)
    return f"{rows}\n\n{text_tables.bullets(table.notes)}\n"


def latex(table: PaperTable) -> str:
    """Return the table as LaTeX that needs no package, with a line above each objective."""
    columns = "l" * len(FIRST) + "r" * len(table.numbers)
    lines = [r"\begin{table}", r"\centering", rf"\begin{{tabular}}{{{columns}}}", r"\hline"]
    lines.append(_latex_line(table.titles))
    for _, rows in groupby(table.lines, key=lambda row: row[:2]):
        lines += [r"\hline", *map(_latex_line, rows)]
    notes = [f"% {note}" for note in table.notes]
    return "\n".join([*lines, r"\hline", r"\end{tabular}", r"\end{table}", *notes]) + "\n"


def in_latex(plain: str) -> str:
    """Return a text in which no character has a meaning in LaTeX."""
    return " ".join(plain.split()).translate(str.maketrans(LATEX))


def _latex_line(cells: Sequence[str]) -> str:
    return " & ".join(map(in_latex, cells)) + r" \\"


FORMATS = (PAPER_TABLE_MARKDOWN, PAPER_TABLE_CSV, PAPER_TABLE_LATEX)


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
    text_tables.write_csv(sweep / PAPER_TABLE_CSV, [table.titles, *table.lines])
    for name, text in ((PAPER_TABLE_MARKDOWN, markdown(table)), (PAPER_TABLE_LATEX, latex(table))):
        with replacing(sweep / name) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return markdown(table)
