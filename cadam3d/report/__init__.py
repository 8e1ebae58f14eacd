"""Report: the page of a run, the page of a sweep, and the charts, tables and verdicts they show."""

from pathlib import Path


def write_sweep(folder: Path) -> Path:
    """Write ``report.html`` and ``figures/`` of the sweep in ``folder`` and return the path of the page."""
    from cadam3d.report.sweep import write  # loads matplotlib and scipy

    return write(folder)


def verdict(folder: Path) -> list[str]:
    """Return the sentences that open the page of the sweep in ``folder``; empty if nothing is comparable."""
    from cadam3d.report.rows import read
    from cadam3d.report.words import headline

    return headline(read(folder))
