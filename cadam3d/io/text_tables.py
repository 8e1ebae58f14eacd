"""Tables: rows of cells as CSV, and as Markdown that can be read in a terminal too."""

import csv
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from cadam3d.io.atomic import replacing

SPECIAL = re.compile(r"([\\|<*`\[])")  # in Markdown; prompts and names may contain them


def write_csv(path: Path, rows: Iterable[Iterable[Any]]) -> None:
    """Write rows as CSV, atomically; the first one has the titles."""
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows(rows)


def markdown(rows: Sequence[Sequence[str]], is_text: Sequence[bool]) -> str:
    """Return rows as a table in Markdown; the first one has the titles.

    A page aligns the columns of text to the left, and the others to the right.
    """
    lines = [[escaped(" ".join(cell.split())) for cell in row] for row in rows]
    widths = [max(3, *map(len, column)) for column in zip(*lines, strict=True)]
    ends = ["-" if each else ":" for each in is_text]
    lines.insert(1, ["-" * (width - 1) + end for width, end in zip(widths, ends, strict=True)])
    padded = [[cell.ljust(width) for cell, width in zip(line, widths, strict=True)] for line in lines]
    return "\n".join(f"| {' | '.join(line)} |" for line in padded)


def bullets(lines: Iterable[str]) -> str:
    """Return a list of sentences, in which names stay text."""
    return "\n".join(f"- {escaped(line)}" for line in lines)


def escaped(text: str) -> str:
    """Return a text in which no character has a meaning in Markdown."""
    return SPECIAL.sub(r"\\\1", text)
