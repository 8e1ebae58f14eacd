"""Report: the page of a run and the page of a sweep, with their charts, figures, tables and verdicts.

The functions here import what they need when they are called: matplotlib, SciPy and Jinja2 take about a
second to load, and a command that writes no report should not wait for them.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cadam3d.core.chart import Chart


def write_report(
    folder: Path,
    *,
    summary: Mapping[str, Any],
    metrics: Sequence[Mapping[str, Any]],
    config_text: str,
    charts: Sequence[Chart] = (),
) -> Path:
    """Write ``report.html`` and ``charts.json`` of the run in ``folder`` and return the path of the page.

    ``summary`` is the content of ``summary.json``, ``metrics`` the lines of ``metrics.jsonl``, and ``charts``
    the declarations of the run's densifier and objective.
    """
    from cadam3d.report.run_page import write

    return write(folder, summary=summary, metrics=metrics, config_text=config_text, charts=charts)


def write_sweep(folder: Path) -> Path:
    """Write ``report.html`` and ``figures/`` of the sweep in ``folder`` and return the path of the page."""
    from cadam3d.report.sweep_page import write

    return write(folder)


def write_paper_table(folder: Path) -> str:
    """Write the paper's table 1 of the sweep in ``folder`` as files, and return it as Markdown.

    Returns "" if its grid does not ask for the table or no job has left an asset. Raises ``UserError`` if a
    file cannot be written.
    """
    from cadam3d.report.table_files import write

    return write(folder)


def verdict(folder: Path) -> list[str]:
    """Return the sentences that open the page of the sweep in ``folder``; empty if nothing is comparable."""
    from cadam3d.report.results import read
    from cadam3d.report.verdicts import headline

    return headline(read(folder))
