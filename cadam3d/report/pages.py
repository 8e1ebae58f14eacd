"""HTML pages made from the templates beside this module. Nothing is fetched.

Autoescape is always on: whatever a user typed reaches a page as text, never as markup. Only drawings, the
styles and the program of the 3D view are marked as safe, in the templates.
"""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from cadam3d import __version__
from cadam3d.io.atomic import replacing
from cadam3d.report.formatting import show
from cadam3d.report.palette import css

TEMPLATES = Path(__file__).with_name("templates")
GOOD, BAD = ("finished",), ("failed", "vanished")  # the other outcomes stopped early with an asset


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
    text = _environment().get_template(template).render(version=__version__, **content)
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


def data_url(path: Path, kind: str) -> str:
    """Return the content of a file as a URL, so that it becomes part of the page; ``kind`` is a MIME type."""
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"


def mood(outcome: str) -> str:
    """Return the CSS class for the outcome of a run: ``good``, ``warn`` or ``bad``."""
    return "good" if outcome in GOOD else "bad" if outcome in BAD else "warn"


def _cell(value: Any, digits: int) -> str:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return f"{value:,.{digits}f}" if is_number else show(value)


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and not value.endswith("%")


def _decimals(value: Any) -> int:
    return len(repr(value).partition(".")[2]) if isinstance(value, float) else 0


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"show": show, "mood": mood, "link": lambda path: quote(str(path))}
    environment.globals["zip"] = zip
    environment.globals["color_variables"] = css()
    return environment
