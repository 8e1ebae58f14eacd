"""Make HTML pages that show Gaussians: one file, without a library and without a request to the network."""

import json
from collections.abc import Sequence
from pathlib import Path

from cadam3d.io.html import content_hash, encoded, fill, source

SOURCES = Path(__file__).parent


def script() -> str:
    """Return the JavaScript that defines the class ``SplatView``, which other pages can contain too."""
    return source(SOURCES / "splat_view.js")


def style() -> str:
    """Return the CSS of the controls that ``SplatView.controls`` makes."""
    return source(SOURCES / "splat_view.css")


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
    code, look = f"{script()}{source(SOURCES / 'page.js')}", f"{style()}{source(SOURCES / 'page.css')}"
    return fill(
        SOURCES / "page.html.jinja",
        title=_printable(title),
        caption=_printable(caption),
        style=look,
        style_hash=content_hash(look),
        script=code,
        script_hash=content_hash(code),
        options=json.dumps(
            {
                "camera": {"azimuth": azimuth_deg, "elevation": elevation_deg},
                "background": None if background is None else [float(channel) for channel in background],
            }
        ),
        data=encoded(packed),
    )


def _printable(text: str) -> str:
    """Return ``text`` with a question mark for each byte of a command line that is not UTF-8."""
    return text.encode(errors="replace").decode()
