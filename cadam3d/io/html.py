"""HTML pages made from templates: the only place that uses Jinja2.

Autoescape is always on: whatever a user typed reaches a page as text, never as markup. Only drawings, styles
and programs of this package are marked as safe, in the templates.
"""

import base64
import hashlib
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined


def fill(template: Path, **content: Any) -> str:
    """Return the text of a page. A template may include or extend those beside it."""
    return _environment(template.parent).get_template(template.name).render(**content)


@cache
def source(path: Path) -> str:
    """Return the text of a style or a program that pages of this package contain."""
    return path.read_text(encoding="utf-8")


def content_hash(text: str) -> str:
    """Return the SHA-256 hash by which the security policy of a page allows a style or a program."""
    return encoded(hashlib.sha256(text.encode()).digest())


def encoded(content: bytes) -> str:
    """Return bytes as text in base64."""
    return base64.b64encode(content).decode("ascii")


def data_url(path: Path, kind: str) -> str:
    """Return the content of a file as a URL, so that it becomes part of a page; ``kind`` is a MIME type."""
    return f"data:{kind};base64,{encoded(path.read_bytes())}"


@cache
def _environment(folder: Path) -> Environment:
    return Environment(
        loader=FileSystemLoader(folder),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
