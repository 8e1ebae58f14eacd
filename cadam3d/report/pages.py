"""Pages: the parts that the page of a run and the page of a sweep share. Nothing in a page is fetched."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from cadam3d import __version__
from cadam3d.core.palette import css
from cadam3d.io.atomic import replacing
from cadam3d.io.html import fill
from cadam3d.report.formatting import show

TEMPLATES = Path(__file__).with_name("templates")
MOODS = {"finished": "good", "failed": "bad", "vanished": "bad"}  # the others stopped early with an asset


@dataclass(frozen=True)
class Table:
    """A table, ready to be shown: every cell is text. Columns of text are aligned to the left."""

    titles: list[str]
    is_text: list[bool]
    lines: list[list[str]]


def table(lines: Sequence[Mapping[str, Any]], *, align_decimals: bool = False) -> Table:
    """Return a table with one column per key of ``lines``.

    With ``align_decimals`` all numbers of a column have as many decimals as the one that has most.
    """
    keys = list(dict.fromkeys(key for line in lines for key in line))
    columns = [[line.get(key) for line in lines] for key in keys]
    # An estimate is text that begins with a sign.
    is_text = [any(isinstance(cell, str) and cell[:1] not in ("+", "-") for cell in each) for each in columns]
    shown = [_aligned(each) if align_decimals else list(map(show, each)) for each in columns]
    return Table(keys, is_text, [list(line) for line in zip(*shown, strict=True)])


def _aligned(column: Sequence[Any]) -> list[str]:
    digits = max(len(repr(value).partition(".")[2]) if isinstance(value, float) else 0 for value in column)
    return [f"{value:,.{digits}f}" if type(value) in (int, float) else show(value) for value in column]


def write_page(path: Path, template: str, **content: Any) -> Path:
    """Fill a template, write the page atomically, and return its path.

    Raises ``UserError`` if the file cannot be written.
    """
    functions = {"show": show, "link": lambda path: quote(str(path)), "mood": mood}
    text = fill(
        TEMPLATES / template, version=__version__, color_variables=css(), zip=zip, **functions, **content
    )
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


def mood(outcome: str) -> str:
    """Return the CSS class for the outcome of a run: ``good``, ``warn`` or ``bad``."""
    return MOODS.get(outcome, "warn")
