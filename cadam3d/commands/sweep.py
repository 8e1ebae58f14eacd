"""``cadam3d sweep``: train many times, and write a table and a report that compares the runs."""

from collections.abc import Sequence
from pathlib import Path

from cadam3d import report
from cadam3d.core.console import complain, show
from cadam3d.core.errors import UserError
from cadam3d.core.signals import ENDING
from cadam3d.io.run_folder import shown
from cadam3d.settings.line import Line
from cadam3d.sweep.plan import read_sweep
from cadam3d.sweep.start import Ended, run_sweep


def run(line: Line) -> int:
    """Run the sweep of a line and report on it. Return 0 if every job has a result, or after a dry run."""
    return carry_out(line).code


def carry_out(line: Line, signals: Sequence[int] = ENDING) -> Ended:
    """Run the sweep of a line, which ``signals`` stop, and report on it."""
    ended = run_sweep(read_sweep(line), signals=signals)
    if not (ended.was_stopped or ended.was_dry):
        write_report(ended.folder)
    return ended


def write_report(folder: Path) -> None:
    """Write the report of the sweep in ``folder`` and print its table. A failure is printed, not raised."""
    try:
        # The page lists the files of the table.
        table = report.write_paper_table(folder)
        page = report.write_sweep(folder)
        if differences := report.comparison(folder):
            show(f"\nDifferences between arms, medians within cells:\n{differences}\n")
        show(f"report: {shown(page)}")
        if table:
            show(f"\n{table}")
    except UserError as error:
        complain(str(error))
