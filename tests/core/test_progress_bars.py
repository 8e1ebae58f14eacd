"""Bars of long work: on a terminal, after a moment, and nowhere else."""

import io
import sys

import pytest

from cadam3d.core import console
from cadam3d.core.console import followed, working


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(("stream", "is_shown"), [(Terminal, True), (io.StringIO, False)])
def test_a_bar_is_shown_on_a_terminal_only(monkeypatch, stream, is_shown):
    monkeypatch.setattr(console, "DELAY_S", 0.0)
    monkeypatch.setattr(sys, "stderr", stream())
    assert list(followed(range(3), "surface")) == [0, 1, 2]
    with working("asset.sog") as refresh:
        refresh()
    shown = sys.stderr.getvalue()
    assert ("surface" in shown, "asset.sog: 00:00" in shown) == (is_shown, is_shown)
    assert bool(shown) == is_shown


def test_short_work_shows_nothing(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    assert list(followed(range(3), "surface")) == [0, 1, 2]
    assert "surface" not in sys.stderr.getvalue()
