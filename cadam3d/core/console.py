"""Console: short messages to the user while a command works, which are neither results nor errors.

The command line prints them. A program that uses cadam3d as a library passes them on to its log instead.
"""

import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

# Receives a message and its level, as in ``logging``.
Listener = Callable[[str, int], None]


def _print(text: str, _level: int) -> None:
    """Print a message on standard error, at once, so that a log can be followed."""
    print(text, file=sys.stderr, flush=True)


_listener: ContextVar[Listener] = ContextVar("listener", default=_print)


def say(text: str, level: int = logging.INFO) -> None:
    """Pass a message on to the listener, which by default prints it on standard error.

    ``level`` is ``logging.WARNING`` if a user should see the message without asking for messages.
    """
    _listener.get()(text, level)


@contextmanager
def heard_by(listener: Listener) -> Iterator[None]:
    """Replace the listener while the block runs."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)
