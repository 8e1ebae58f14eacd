"""Requests to pause, save and stop, as a run carries them out between two steps."""

import pytest
import torch

from cadam3d.build import build_trainer, component
from cadam3d.commands import control
from cadam3d.commands.control import Control
from cadam3d.io import live
from cadam3d.io.ply import read_ply
from cadam3d.settings.compose import compose


class Run:
    """A run in which nothing happens except what ``Control`` does."""

    def __init__(self, folder, state):
        self.folder, self.state, self.signals, self.waits = folder, state, [], []
        self.while_waiting = lambda: None
        self.control = Control(folder, self.state, lambda: bool(self.signals), self._wait)

    def _wait(self):
        self.waits.append(None)
        assert len(self.waits) < 20, "the pause does not end"
        self.while_waiting()

    def ask(self, *requests):
        for request in requests:
            assert live.ask(self.folder, request)
        self.control._look_at = 0.0
        return self.control()


@pytest.fixture(scope="module")
def state():
    cfg = compose(["prompt=a red cube", "prior=tiny", "rasterizer=reference", "initializer.count=5"])
    cpu = torch.device("cpu")
    state = build_trainer(cfg, cpu).start(cfg.prompt, component(cfg.initializer), 0, cpu)
    state.step = 7
    return state


@pytest.fixture
def run(tmp_path, monkeypatch, state):
    monkeypatch.setattr(control.time, "sleep", lambda seconds: None)
    run = Run(tmp_path, state)
    with run.control:
        live.begin(tmp_path)
        yield run


def test_a_run_waits_until_the_pause_is_withdrawn(run, capsys):
    run.while_waiting = lambda: live.withdraw(run.folder, "pause") if len(run.waits) == 3 else None
    assert not run.ask("pause")
    assert len(run.waits) == 3
    printed = capsys.readouterr().err
    assert "Paused after step 7" in printed
    assert f"rm {run.folder / 'live/pause'}" in printed


def test_a_signal_ends_a_pause_and_the_run(run):
    run.while_waiting = lambda: run.signals.append(2)
    assert run.ask("pause")
    assert len(run.waits) == 1


def test_stop_ends_a_pause_and_the_run(run):
    run.while_waiting = lambda: live.ask(run.folder, "stop")
    assert run.ask("pause")
    assert not live.is_asked(run.folder, "stop")


def test_a_paused_run_saves_too(run):
    run.while_waiting = lambda: (
        live.ask(run.folder, "save") if len(run.waits) == 1 else live.ask(run.folder, "stop")
    )
    run.ask("pause")
    assert (run.folder / "saved/step_0000007.ply").is_file()


def test_a_saved_asset_reads_back_and_the_run_goes_on(run, capsys):
    assert not run.ask("save")
    saved = read_ply(run.folder / "saved/step_0000007.ply")
    assert torch.allclose(saved.means, run.state.gaussians.means, atol=1e-6)
    assert (run.folder / "saved/step_0000007.pt").is_file()
    assert "Saved" in capsys.readouterr().err
    assert not live.is_asked(run.folder, "save")


def test_a_failure_to_save_is_a_warning(run, capsys):
    (run.folder / "saved").write_text("in the way")
    assert not run.ask("save")
    assert "Warning: not saved: " in capsys.readouterr().err


def test_requests_to_an_earlier_process_are_forgotten(run):
    for request in live.REQUESTS:
        live.ask(run.folder, request)
    with run.control:
        assert not run.control()
    assert not (run.folder / "live").exists()
