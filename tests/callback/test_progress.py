"""The progress bar: current step, time of the end, and peak memory of the GPU."""

import re
import time
from functools import partial

import pytest
import torch

from cadam3d.callback import progress
from cadam3d.callback.progress import Progress, clock, peak_memory
from cadam3d.commands.train import build_trainer
from cadam3d.settings.compose import component, compose
from cadam3d.state import RunContext, StepReport

CPU = torch.device("cpu")
NOON = time.mktime((2026, 3, 4, 12, 0, 0, 0, 0, -1))  # local time, a Wednesday


class Clock:
    """Replaces the clock of the bar and of tqdm; reading it takes no time."""

    def __init__(self) -> None:
        self.now = NOON

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def at_noon(monkeypatch) -> Clock:
    watch = Clock()
    monkeypatch.setattr(progress.time, "time", watch)
    monkeypatch.setattr("tqdm.std.time", watch)
    return watch


@pytest.fixture
def run(tmp_path):
    cfg = compose(["prompt=a red cube", "prior=tiny", "rasterizer=reference", "initializer.count=5"])
    trainer = build_trainer(cfg, CPU)
    state = trainer.start(cfg.prompt, component(cfg.initializer), 0, CPU)
    return RunContext(tmp_path, cfg.prompt, 10, trainer.renderer(state), trainer.rasterizer), state


def step(bar: Progress, run, number: int) -> None:
    context, state = run
    state.step = number
    bar.on_step(context, state, StepReport(step=number, loss=0.5, log={}, num_gaussians=5))


def last_line(capsys) -> str:
    return re.split(r"[\r\n]", capsys.readouterr().err.rstrip())[-1]


def test_the_bar_shows_the_step_and_the_time_of_the_end(at_noon, run, capsys):
    bar = Progress(refresh_seconds=0.0)
    bar.on_start(*run)
    for number in range(1, 5):
        at_noon.now += 600  # ten minutes per step, so six more steps take an hour
        step(bar, run, number)
    line = last_line(capsys)
    assert "4/10" in line
    assert "N=5" in line
    assert "loss=0.5" in line
    assert "done=13:40" in line
    assert "VRAM" not in line  # only on CUDA devices


def test_the_pace_of_a_resumed_run_counts_only_its_own_steps(at_noon, run, capsys):
    bar = Progress(refresh_seconds=0.0)
    run[1].step = 6
    bar.on_start(*run)
    at_noon.now += 60
    step(bar, run, 7)
    line = last_line(capsys)
    assert "7/10" in line
    assert "done=12:04" in line


def test_a_finished_run_shows_no_time_of_the_end(at_noon, run, capsys):
    bar = Progress(refresh_seconds=0.0)
    bar.on_start(*run)
    for number in range(1, 11):
        at_noon.now += 1
        step(bar, run, number)
    line = last_line(capsys)
    assert "10/10" in line
    assert "done=" not in line


def test_a_disabled_bar_raises_no_error(run, capsys, monkeypatch):
    """Users and cluster scripts do this with the environment variable TQDM_DISABLE."""
    monkeypatch.setattr(progress, "tqdm", partial(progress.tqdm, disable=True))
    bar = Progress(refresh_seconds=0.0)
    bar.on_start(*run)
    step(bar, run, 1)
    bar.on_abort(run[0])
    assert capsys.readouterr().err == ""


def test_the_bar_shows_the_peak_of_the_gpu(at_noon, run, capsys, monkeypatch):
    monkeypatch.setattr(progress, "peak_memory", lambda device: int(7.26 * 2**30))
    bar = Progress(refresh_seconds=0.0)
    bar.on_start(*run)
    at_noon.now += 1
    step(bar, run, 1)
    assert "VRAM=7.3GiB" in last_line(capsys)


def test_peak_memory_is_known_on_cuda_devices_only(monkeypatch):
    devices = []
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda device: devices.append(device) or 123)
    assert peak_memory(torch.device("cuda:1")) == 123
    assert devices == [torch.device("cuda:1")]
    assert peak_memory(CPU) is None
    assert len(devices) == 1


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_the_peak_includes_memory_that_was_freed_since():
    device = torch.device("cuda")
    torch.cuda.reset_peak_memory_stats(device)
    block = torch.empty(2**26, dtype=torch.uint8, device=device)
    del block
    assert peak_memory(device) >= 2**26


@pytest.mark.parametrize(
    ("seconds", "shown"),
    [(0, "12:00"), (3600 * 11.5, "23:30"), (3600 * 13, "01:00"), (3600 * 37, "Fri 01:00")],
)
def test_the_clock_shows_the_weekday_if_the_time_is_a_day_or_more_away(seconds, shown):
    assert clock(NOON, seconds) == shown
