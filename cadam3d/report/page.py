"""The look that our HTML pages share, and how numbers are written on them. No scripts, nothing fetched."""

import base64
import math
from collections.abc import Iterable
from html import escape
from importlib import resources
from pathlib import Path

GOOD, SERIOUS = ("finished",), ("failed", "vanished")  # outcomes; the others stopped early with an asset


def page(title: str, body: Iterable[str], more_style: str = "") -> str:
    """A whole page around the parts of ``body``; empty parts are left out. ``title`` is escaped here."""
    style = resources.files("cadam3d.report").joinpath("page.css").read_text(encoding="utf-8")
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>\n{style}{more_style}</style>\n</head>\n<body>\n<main>\n"
        + "\n".join(part for part in body if part)
        + "\n</main>\n</body>\n</html>\n"
    )


def outcome_chip(outcome: str) -> str:
    """The outcome of a run as a pill, coloured by how bad it is."""
    mood = "good" if outcome in GOOD else "bad" if outcome in SERIOUS else "warn"
    return f'<span class="outcome {mood}">{escape(outcome.replace("_", " "))}</span>'


def tile(label: str, value: str, remark: str) -> str:
    """A number that people ask for first, as a card."""
    return (
        f'<div class="card tile"><p>{escape(label)}</p><strong>{escape(value)}</strong>'
        f"<p>{escape(remark)}</p></div>"
    )


def note(text: object) -> str:
    """A remark across the page."""
    return f'<p class="note warn">{escape(str(text))}</p>'


def details(title: str, content: str) -> str:
    """What is folded away at first; ``content`` is markup."""
    return f'<details class="card"><summary>{escape(title)}</summary>{content}</details>'


def data_url(path: Path, kind: str) -> str:
    """A file as part of the page."""
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"


def number(value: object) -> float | None:
    """``value`` if it is a finite number, else ``None``."""
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if is_number else None  # pyright: ignore[reportArgumentType]


def show(value: object) -> str:
    """A value as people write it; a dash for nothing."""
    if value is None or value == "" or (isinstance(value, float) and not math.isfinite(value)):
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}" if abs(value) >= 10_000 else str(value)
    if isinstance(value, float):
        return f"{value:,.0f}" if value.is_integer() and abs(value) < 1e15 else f"{value:.4g}"
    if isinstance(value, (list, tuple)):
        return ", ".join(str(item) for item in value) or "-"
    return str(value)


def shown_bytes(count: float) -> str:
    """Bytes in the unit that suits them."""
    for unit, size in (("GiB", 1 << 30), ("MiB", 1 << 20), ("KiB", 1 << 10)):
        if count >= size:
            return f"{count / size:.1f} {unit}"
    return f"{count:.0f} B"


def duration(seconds: float) -> str:
    """Seconds, or hours and minutes."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s"
