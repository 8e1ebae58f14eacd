"""Console: the one place that prints, so that no text from a stranger's file can steer the terminal.

Commands show results, complain about errors, and say what they do meanwhile. A program that uses cadam3d as a
library passes on all of this to its log instead.
"""

import logging
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

T = TypeVar("T")

# Receives a message and its level, as in ``logging``.
Listener = Callable[[str, int], None]
# Control characters except line feeds and tabs, marks that reverse the order of letters, halves of letters.
INVISIBLE = re.compile(
    "[\\x00-\\x08\\x0b-\\x1f\\x7f-\\x9f\\u061c\\u200e\\u200f\\u2028-\\u202e\\u2066-\\u2069\\ud800-\\udfff]"
)


def visible(text: str) -> str:
    """Return ``text`` with the characters that a terminal obeys or cannot show spelled as in Python."""
    return INVISIBLE.sub(lambda match: match[0].encode("unicode_escape").decode(), text)


DELAY_S = 1.0  # before a bar appears

_listener: ContextVar[Listener | None] = ContextVar("listener", default=None)


def show(text: str) -> None:
    """Print a result on standard output."""
    _pass_on(text, logging.INFO, lambda: print(visible(text), flush=True))


def complain(text: str) -> None:
    """Print an error on standard error. Its further lines cannot pass for messages of ours."""
    shown = f"cadam3d: {visible(text)}".replace("\n", "\n  ")
    _pass_on(text, logging.WARNING, lambda: print(shown, file=sys.stderr, flush=True))


def say(text: str, level: int = logging.INFO) -> None:
    """Print a message on standard error, at once, so that a log can be followed.

    ``level`` is ``logging.WARNING`` if a user should see the message without asking for messages.
    """
    _pass_on(text, level, lambda: print(visible(text), file=sys.stderr, flush=True))


def _pass_on(text: str, level: int, otherwise: Callable[[], None]) -> None:
    """Pass a text on to the listener; without one, do something else."""
    listener = _listener.get()
    otherwise() if listener is None else listener(text, level)


@contextmanager
def heard_by(listener: Listener) -> Iterator[None]:
    """Pass everything to ``listener``, and print nothing, while the block runs."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


def followed(items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
    """Yield ``items``; on a terminal, work of more than a second shows a bar on standard error meanwhile."""
    from tqdm import tqdm  # slow to import

    yield from tqdm(items, label, total, leave=False, delay=DELAY_S, disable=None)


@contextmanager
def working(label: str) -> Iterator[Callable[[], object]]:
    """Show on a terminal how long the block works, if it takes more than a second.

    The block gets a function, which it calls often and which updates the time.
    """
    from tqdm import tqdm  # slow to import

    with tqdm(desc=label, bar_format="{desc}: {elapsed}", leave=False, delay=DELAY_S, disable=None) as bar:
        yield lambda: bar.update(1)
