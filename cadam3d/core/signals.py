"""Signals: Ctrl-C, SIGTERM or a closed terminal asks a long work to save and stop.

A second Ctrl-C or SIGTERM ends the work at once.
"""

import errno
import logging
import os
import signal
import time
from collections.abc import Callable, Sequence
from types import FrameType
from typing import Any

from cadam3d.core.console import say

# Signals that arrive within this time of each other count as one.
TOGETHER_SECONDS = 1.0
# Sent when the terminal closes. Windows has no such signal.
HANGUP = getattr(signal, "SIGHUP", None)
# The signals after which a command saves.
ENDING = (signal.SIGINT, signal.SIGTERM, *([] if HANGUP is None else [HANGUP]))


class StopOnSignal:
    """Handles signals: after the first one the loop stops and saves, a later one stops it at once.

    Signals within ``TOGETHER_SECONDS`` count as one, because a scheduler sends its signal to a process and
    also to its parent, which passes it on. A closed terminal is not impatience, so it never counts as a later
    signal, and under ``nohup`` it does not count at all.
    """

    def __init__(self, numbers: Sequence[int], on_first: Callable[[], None] = lambda: None) -> None:
        self.received: int | None = None
        self._numbers, self._on_first = numbers, on_first
        self._received_at = 0.0
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> "StopOnSignal":
        for number in self._numbers:
            if number == HANGUP and signal.getsignal(number) == signal.SIG_IGN:
                continue
            self._previous[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def __call__(self) -> bool:
        """Return whether a signal has arrived."""
        return self.received is not None

    def _handle(self, number: int, _frame: FrameType | None) -> None:
        if number == HANGUP:
            _leave_terminal()
        if self.received is not None:
            if number == HANGUP or time.monotonic() - self._received_at < TOGETHER_SECONDS:
                return
            raise KeyboardInterrupt
        self.received, self._received_at = number, time.monotonic()
        self._on_first()
        say("\nStopping as soon as everything is saved; interrupt again to stop at once.", logging.WARNING)


def _leave_terminal() -> None:
    """Print into nothing from now on if the terminal is closed, where printing raises an error."""
    import termios  # not on Windows, which has no such signal either

    for stream in (1, 2):
        try:
            termios.tcgetattr(stream)
        except termios.error as error:
            if error.args[0] == errno.EIO:
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
