"""What a sweep says: its jobs as rows, claims about densifiers, figures, and the page that shows them."""

from pathlib import Path


def write(sweep_folder: Path) -> Path:
    """Write ``report.html`` and ``figures/`` of a sweep, from whatever jobs are there; returns the page."""
    from cadam3d.comparison.page import write as write_page  # matplotlib and scipy: only when they are used

    return write_page(sweep_folder)


def verdict(sweep_folder: Path) -> list[str]:
    """What the page says first, in sentences; none where there is nothing to compare."""
    from cadam3d.comparison.rows import read
    from cadam3d.comparison.words import headline

    return headline(read(sweep_folder))
