"""Progress: a bar in a terminal and lines elsewhere, with step, speed and peak GPU memory."""

import re
import time

import pytest
import torch
from _pytest.capture import CaptureIO

from cadam3d.callback import progress
from cadam3d.callback.progress import Progress, peak_memory
from cadam3d.state import Outcome, StepReport

CPU = torch.device("cpu")
NOON = time.mktime((2026, 3, 4, 12, 0, 0, 0, 0, -1))  # local time, a Wednesday


class Clock:
    """Replaces the clock of the bar and of tqdm; reading it takes no time."""

    def __init__(self) -> None:
        self.now = NOON

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def bar(monkeypatch, capsys) -> Progress:
    """Return the progress of a run whose standard error is a terminal."""
    # The class, because pytest changes the object between the fixtures and the test.
    monkeypatch.setattr(CaptureIO, "isatty", lambda self: True)
    return Progress(refresh_seconds=0.0, line_seconds=10.0)


@pytest.fixture
def lines(monkeypatch, capsys) -> Progress:
    """Return the progress of a run whose standard error is no terminal."""
    monkeypatch.delenv("TQDM_DISABLE", raising=False)
    return Progress(refresh_seconds=0.0, line_seconds=10.0)


@pytest.fixture
def at_noon(monkeypatch) -> Clock:
    watch = Clock()
    monkeypatch.setattr(progress.time, "time", watch)
    monkeypatch.setattr(progress.time, "monotonic", watch)
    monkeypatch.setattr("tqdm.std.time", watch)
    return watch


@pytest.fixture
def run(begin, tmp_path):
    _, state, _, context = begin(tmp_path, "steps=10")
    return context, state


def step(bar: Progress, run, number: int) -> None:
    context, state = run
    state.step = number
    bar.on_step(context, state, StepReport(step=number, loss=0.5, log={}, num_gaussians=5))


def last_line(capsys) -> str:
    return re.split(r"[\r\n]", capsys.readouterr().err.rstrip())[-1]


def test_the_bar_shows_the_step_and_the_loss(bar, at_noon, run, capsys):
    bar.on_start(*run)
    for number in range(1, 5):
        at_noon.now += 600  # ten minutes per step, so six more steps take an hour
        step(bar, run, number)
    line = last_line(capsys)
    assert "4/10" in line
    assert "N=5" in line
    assert "loss=0.5" in line
    assert "VRAM" not in line  # only on CUDA devices
    assert "step 4" not in line  # a bar, not a line


def test_the_bar_leaves_a_pause_out(bar, at_noon, run, capsys):
    bar.on_start(*run)
    at_noon.now += 60
    step(bar, run, 1)
    for _ in range(4):
        at_noon.now += 900
        bar.on_pause(*run)
    at_noon.now += 60
    step(bar, run, 2)
    bar.on_end(*run, Outcome.INTERRUPTED)
    assert "[02:00<" in last_line(capsys)


def test_the_speed_of_a_resumed_run_counts_only_its_own_steps(lines, run, capsys):
    run[1].step, run[1].seconds = 6, 500.0
    lines.on_start(*run)
    run[1].seconds += 4
    step(lines, run, 7)
    assert "speed=0.25 steps/s" in last_line(capsys)


def test_elsewhere_there_is_a_whole_line_for_the_first_and_last_step_and_every_few_seconds(
    at_noon, run, lines, capsys
):
    lines.on_start(*run)
    for number in range(1, 11):
        at_noon.now += 4
        run[1].seconds += 4
        step(lines, run, number)
    lines.on_end(*run, Outcome.FINISHED)
    printed = capsys.readouterr().err
    assert "\r" not in printed
    assert printed.endswith("\n")
    shown = printed.splitlines()
    assert re.findall(r"step (\d+)/10", printed) == ["1", "4", "7", "10"]
    assert shown[1] == "a red cube: step 4/10, speed=0.25 steps/s, N=5, loss=0.5"
    assert shown[3] == "a red cube: step 10/10, speed=0.25 steps/s, N=5, loss=0.5"


@pytest.mark.parametrize("end", ["on_end", "on_abort"])
def test_a_run_that_ends_early_prints_its_last_step(at_noon, run, lines, capsys, end):
    lines.on_start(*run)
    for number in (1, 2, 3):
        step(lines, run, number)
    arguments = {"on_end": (*run, Outcome.MAX_GAUSSIANS), "on_abort": run[:1]}[end]
    getattr(lines, end)(*arguments)
    assert [line.split(",")[0] for line in capsys.readouterr().err.splitlines()] == [
        "a red cube: step 1/10",
        "a red cube: step 3/10",
    ]


def test_the_bar_shows_the_peak_of_the_gpu(bar, at_noon, run, capsys, monkeypatch):
    monkeypatch.setattr(progress, "peak_memory", lambda device: int(7.26 * 2**30))
    bar.on_start(*run)
    at_noon.now += 1
    step(bar, run, 1)
    assert "VRAM=7.3GiB" in last_line(capsys)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_the_peak_includes_memory_that_was_freed_since():
    device = torch.device("cuda")
    torch.cuda.reset_peak_memory_stats(device)
    block = torch.empty(2**26, dtype=torch.uint8, device=device)
    del block
    assert peak_memory(device) >= 2**26
