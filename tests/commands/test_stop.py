"""Signals to training: after the first one it saves and ends, and a later one stops it at once."""

import os
import signal

import pytest

from cadam3d.core.signals import TOGETHER_SECONDS, StopOnSignal

BOTH = (signal.SIGINT, signal.SIGTERM)


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr("cadam3d.commands.control.time.monotonic", lambda: now[0])
    return now


@pytest.mark.parametrize("number", BOTH)
def test_the_first_signal_is_recorded_and_the_handlers_are_restored(number, clock):
    before = signal.getsignal(number)
    with StopOnSignal(BOTH) as stop:
        assert not stop()
        os.kill(os.getpid(), number)
        assert stop()
        assert stop.received == number
    assert signal.getsignal(number) == before


def test_a_signal_that_arrives_twice_within_a_second_counts_once(clock):
    with StopOnSignal(BOTH) as stop:
        os.kill(os.getpid(), signal.SIGTERM)
        clock[0] += 0.9 * TOGETHER_SECONDS
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.received == signal.SIGTERM


def test_a_later_signal_stops_at_once(clock):
    with StopOnSignal(BOTH):
        os.kill(os.getpid(), signal.SIGINT)
        clock[0] += 1.1 * TOGETHER_SECONDS
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
