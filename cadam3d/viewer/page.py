"""Make HTML pages that show Gaussians: one file, without a library and without a request to the network."""

import base64
import hashlib
import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined

SOURCES = Path(__file__).parent


def script() -> str:
    """Return the JavaScript that defines the class ``SplatView``, which other pages can contain too."""
    return _source("splat_view.js")


def style() -> str:
    """Return the CSS of the controls that ``SplatView.controls`` makes."""
    return _source("splat_view.css")


def viewer_page(
    packed: bytes,
    *,
    title: str,
    caption: str = "",
    azimuth_deg: float = 30.0,
    elevation_deg: float = 15.0,
    background: Sequence[float] | None = None,
) -> str:
    """Return a complete HTML page that shows the snapshot ``packed`` in its whole window.

    It works from a file. ``title`` and ``caption`` are shown as text, whatever they contain. The angles are
    those of the first view. ``background`` is RGB in [0, 1]; None means white, or dark for readers who prefer
    dark pages. A policy in the page forbids every request and every other script.
    """
    code, look = f"{script()}{_source('page.js')}", f"{style()}{_source('page.css')}"
    environment = Environment(loader=FileSystemLoader(SOURCES), autoescape=True, undefined=StrictUndefined)
    return environment.get_template("page.html.jinja").render(
        title=_printable(title),
        caption=_printable(caption),
        style=look,
        style_hash=_hash(look),
        script=code,
        script_hash=_hash(code),
        options=json.dumps(
            {
                "camera": {"azimuth": azimuth_deg, "elevation": elevation_deg},
                "background": None if background is None else [float(channel) for channel in background],
            }
        ),
        data=base64.b64encode(packed).decode(),
    )


@cache
def _source(name: str) -> str:
    return (SOURCES / name).read_text(encoding="utf-8")


def _printable(text: str) -> str:
    """Return ``text`` with a question mark for each byte of a command line that is not UTF-8."""
    return text.encode(errors="replace").decode()


def _hash(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
