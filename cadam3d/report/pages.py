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
GOOD, BAD = ("finished",), ("failed", "vanished")  # the other outcomes stopped early with an asset
# What the templates call.
FUNCTIONS: dict[str, Any] = {"show": show, "zip": zip, "link": lambda path: quote(str(path))}


@dataclass(frozen=True)
class Tile:
    """A number in large print, with a label above and a remark below."""

    label: str
    value: str
    remark: str


@dataclass(frozen=True)
class Column:
    """The head of a column of a table."""

    title: str
    is_text: bool  # aligned to the left
    is_link: bool  # the cells are names of folders, each with a report


@dataclass(frozen=True)
class Table:
    """A table, ready to be shown: every cell is text."""

    columns: list[Column]
    lines: list[list[str]]


def table(lines: Sequence[Mapping[str, Any]], *, link: str = "", align_decimals: bool = False) -> Table:
    """Return a table with one column per key of ``lines``.

    The cells of column ``link`` become links to the reports of jobs. With ``align_decimals`` all numbers of a
    column have as many decimals as the one that has most.
    """
    keys = list(dict.fromkeys(key for line in lines for key in line))
    digits = {key: max((_decimals(line.get(key)) for line in lines), default=0) for key in keys}
    columns = [
        Column(title=key, is_text=any(_is_text(line.get(key)) for line in lines), is_link=key == link)
        for key in keys
    ]
    cells = [
        [_cell(line.get(key), digits[key]) if align_decimals else show(line.get(key)) for key in keys]
        for line in lines
    ]
    return Table(columns, cells)


def write_page(path: Path, template: str, **content: Any) -> Path:
    """Fill a template, write the page atomically, and return its path.

    Raises ``UserError`` if the file cannot be written.
    """
    text = fill(
        TEMPLATES / template, version=__version__, color_variables=css(), mood=mood, **FUNCTIONS, **content
    )
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


def mood(outcome: str) -> str:
    """Return the CSS class for the outcome of a run: ``good``, ``warn`` or ``bad``."""
    return "good" if outcome in GOOD else "bad" if outcome in BAD else "warn"


def _cell(value: Any, digits: int) -> str:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return f"{value:,.{digits}f}" if is_number else show(value)


def _is_text(value: Any) -> bool:
    # An estimate is text that begins with a sign.
    return isinstance(value, str) and value[:1] not in ("+", "-")


def _decimals(value: Any) -> int:
    return len(repr(value).partition(".")[2]) if isinstance(value, float) else 0
