"""Signals to training: after the first one it saves and ends, and a later one stops it at once."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from cadam3d.core.signals import ENDING, TOGETHER_SECONDS, StopOnSignal

BOTH = (signal.SIGINT, signal.SIGTERM)
needs_hangup = pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="Windows has no such signal")


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


@needs_hangup
def test_a_closed_terminal_saves_and_never_counts_as_a_later_signal(clock):
    """A shell that ends sends its signal again, long after the first one."""
    with StopOnSignal(ENDING) as stop:
        os.kill(os.getpid(), signal.SIGHUP)
        clock[0] += 10 * TOGETHER_SECONDS
        os.kill(os.getpid(), signal.SIGHUP)
        assert stop.received == signal.SIGHUP


@needs_hangup
def test_under_nohup_a_closed_terminal_changes_nothing(clock):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopOnSignal(ENDING) as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not stop()
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


@needs_hangup
def test_a_program_whose_terminal_is_gone_can_still_print(tmp_path):
    """Printing into a closed terminal is an error, which would end the training before it has saved."""
    code = (
        "import pathlib, time\n"
        "from cadam3d.core.signals import ENDING, StopOnSignal\n"
        "with StopOnSignal(ENDING) as stop:\n"
        "    print('begun', flush=True)\n"
        "    while not stop(): time.sleep(0.01)\n"
        "    print('x' * 10_000, flush=True)\n"
        "    pathlib.Path('saved').touch()\n"
    )
    master, slave = os.openpty()
    process = subprocess.Popen(
        [sys.executable, "-c", f"import fcntl, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0)\n{code}"],
        **dict.fromkeys(("stdin", "stdout", "stderr"), slave),
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
        start_new_session=True,
    )
    os.close(slave)
    while b"begun" not in os.read(master, 100):
        pass
    os.close(master)
    assert process.wait(20) == 0
    assert (tmp_path / "saved").exists()
