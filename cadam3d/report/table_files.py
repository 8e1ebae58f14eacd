"""Files of the paper's table in the folder of a sweep: table.md, table.csv and table.tex."""

from pathlib import Path

from cadam3d.io.atomic import replacing
from cadam3d.io.run_folder import PAPER_TABLE_CSV, PAPER_TABLE_LATEX, PAPER_TABLE_MARKDOWN
from cadam3d.report.paper_table import PaperTable, paper_table
from cadam3d.report.results import read
from cadam3d.report.table_formats import comma_separated, latex, markdown
from cadam3d.sweep.folder import read_plan

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
