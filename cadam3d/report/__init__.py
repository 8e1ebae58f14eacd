"""Report: the page of a run and the page of a sweep, with their charts, figures and tables.

The functions here import what they need when they are called: matplotlib, SciPy and Jinja2 take about a
second to load, and a command that writes no report should not wait for them.
"""

from collections.abc import Sequence
from pathlib import Path

from cadam3d.io.run_folder import FIGURES


def write_report(folder: Path) -> Path:
    """Write ``report.html`` of the run in ``folder`` from its files, and return the path of the page."""
    from cadam3d.report.run_page import write

    return write(folder)


def write_sweep(folder: Path, baseline: str | None = None) -> Path:
    """Write ``report.html`` and ``figures/`` of the sweep in ``folder`` and return the path of the page.

    The other arms are compared with the arm ``baseline``, by default the first one that adds Gaussians.
    """
    from cadam3d.report.sweep_page import write

    return write(folder, baseline=baseline)


def write_paper_table(folder: Path) -> str:
    """Write the paper's table 1 of the sweep in ``folder`` as files, and return it as Markdown.

    Returns "" if its grid does not ask for the table or no job has left an asset. Raises ``UserError`` if a
    file cannot be written.
    """
    from cadam3d.report.paper_formats import write

    return write(folder)


def comparison(folder: Path, baseline: str | None = None) -> str:
    """Return the table of a sweep that compares its arms, as text; "" if nothing is comparable."""
    from cadam3d.report.results import read
    from cadam3d.report.tables import comparison_table, shown_comparison
    from cadam3d.sweep.table import aligned

    results = read(folder)
    lines = shown_comparison(comparison_table(results, baseline), results)
    return aligned([list(lines[0]), *(list(line.values()) for line in lines)]) if lines else ""


def compare_two(folder: Path, names: Sequence[str]) -> tuple[str, list[Path]]:
    """Return how the first of two arms or settings differs from the second, as text and as CSV files.

    The name of an arm stands for its main setting, and a setting has the name that tables give it. Raises
    ``UserError`` for other names, if no cell has both, and if a file cannot be written.
    """
    from cadam3d.report.compare import named_settings
    from cadam3d.report.results import read
    from cadam3d.report.tables import shown_estimates, two_settings, write
    from cadam3d.settings.compose import slug
    from cadam3d.sweep.table import aligned

    results = read(folder)
    ours, theirs = named_settings(results, names)
    numbers, cells = two_settings(results, ours, theirs)
    name = f"{slug(ours.name)}-minus-{slug(theirs.name)}"
    files = [folder / FIGURES / f"{name}{part}.csv" for part in ("", "-cells")]
    for file, lines in zip(files, (numbers, cells), strict=True):
        write(file, lines)
    lines = shown_estimates(numbers, results)
    text = aligned([list(lines[0]), *(list(line.values()) for line in lines)])
    return f"{ours.name} minus {theirs.name}:\n{text}", files
