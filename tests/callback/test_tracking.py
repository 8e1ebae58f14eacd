"""TensorBoard and Weights & Biases: what they record, how they continue, and that no run needs them."""

import os
import shutil
import socket
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from composed import as_yaml, composed

from cadam3d.callback import tracking
from cadam3d.callback import wandb as wandb_callback
from cadam3d.callback.previews import Previews
from cadam3d.callback.tensorboard import TensorBoard
from cadam3d.callback.tracking import Tracking
from cadam3d.callback.wandb import Wandb, has_key, known_run
from cadam3d.commands.train import build_trainer, run_context
from cadam3d.core.errors import UserError
from cadam3d.initializer.base import Initializer
from cadam3d.io.run_folder import JOBS
from cadam3d.settings.compose import component

CPU = torch.device("cpu")
SMALL = ("prompt=a red cube", "prior=tiny", "rasterizer=reference", "camera.size=12", "initializer.count=30")
GROWING = ("refine.start=0", "refine.end=100", "refine.interval=4", "callback=[previews]")
PICTURES = ("callback.previews.every=4", "callback.previews.views=2", "callback.previews.size=8")
LINE = (*SMALL, *GROWING, *PICTURES)
SUMMARY = {"steps": 10, "psnr": 21.5, "outcome": "finished", "num_gaussians": 31, "warnings": []}


def prepare(folder: Path) -> None:
    """Write the files with the settings that a run has before its callbacks start."""
    (folder / ".hydra").mkdir(parents=True, exist_ok=True)
    (folder / "config.yaml").write_text(as_yaml(*LINE))
    (folder / ".hydra/overrides.yaml").write_text("- prompt=a red cube\n- +densifier=cadam\n")


def train(folder: Path, *trackers: Tracking, steps: int = 10, state=None):
    """Train to ``steps``, on from ``state`` if there is one, and return the state."""
    prepare(folder)
    cfg = composed(*LINE, f"steps={steps}")
    trainer = build_trainer(cfg, CPU)
    # The trackers are first, so that the preview of a step is drawn after they were called.
    trainer.callbacks[:0] = trackers
    embedding = trainer.prior.embed(cfg.prompt, cfg.negative_prompt)
    if state is None:
        initializer = component(cfg.initializer, Initializer, "initializer")
        state = trainer.start(cfg.prompt, initializer, cfg.seed, CPU)
    context = run_context(cfg.prompt, trainer, state, folder)
    trainer.train(state, embedding, context)
    for tracker in trackers:
        tracker.on_result(context, {**SUMMARY, "steps": steps})
    return state


class Recorder(Tracking):
    """A tracker that keeps everything in a list, and fails when it is asked to."""

    package = "torch"

    def __init__(self, fails_at: int | None = None):
        self.every, self.fails_at, self.calls = 4, fails_at, []

    def open(self, context, step):
        self.calls.append(("open", step))

    def record(self, step, numbers, preview):
        if step == self.fails_at:
            raise ConnectionResetError("the server is gone")
        self.calls.append((step, sorted(numbers), preview and preview.name))

    def conclude(self, context, step, results):
        self.calls.append(("conclude", step, results))

    def close(self, *, is_complete):
        self.calls.append(("close", is_complete))


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    return train(tmp_path_factory.mktemp("alone"))


# --- what both have in common -----------------------------------------------------------------------------


def test_a_step_has_its_preview_wherever_the_previews_are_in_the_list(tmp_path):
    recorder = Recorder()
    train(tmp_path, recorder)
    steps = {call[0]: call[1:] for call in recorder.calls if isinstance(call[0], int)}
    assert list(steps) == [1, 4, 8, 10]
    assert [steps[step][1] for step in steps] == [None, "step_000004.png", "step_000008.png", None]
    assert {"train/loss", "train/num_gaussians", "train/seconds"} <= set(steps[1][0])
    assert {"refine/before", "refine/cloned", "refine/snr_p50"} <= set(steps[8][0])
    results = {"result/steps": 10, "result/psnr": 21.5, "result/num_gaussians": 31}
    assert recorder.calls[-2:] == [("conclude", 10, results), ("close", True)]


def test_a_tracker_that_fails_costs_only_itself(tmp_path, alone, capsys):
    broken, sound = Recorder(fails_at=4), Recorder()
    state = train(tmp_path, broken, sound)
    message = capsys.readouterr().err
    assert message.count("Warning: callback.torch has stopped") == 1
    assert "the server is gone" in message
    assert broken.calls[-1][0] == 1
    assert sound.calls[-1] == ("close", True)
    assert torch.equal(state.gaussians.means, alone.gaussians.means)


def test_a_run_that_ends_with_an_error_closes_its_tracker(tmp_path, monkeypatch):
    def fail(*_):
        raise ZeroDivisionError

    monkeypatch.setattr(Previews, "on_step", fail)
    recorder = Recorder()
    with pytest.raises(ZeroDivisionError):
        train(tmp_path, recorder)
    assert recorder.calls[1:] == [(1, recorder.calls[1][1], None), ("close", False)]


@pytest.mark.parametrize("name", ["tensorboard", "wandb"])
def test_a_missing_package_names_its_extra(name, monkeypatch):
    monkeypatch.setattr(tracking, "find_spec", lambda _: None)
    with pytest.raises(UserError) as raised:
        component(composed(f"callback=[{name}]", "prompt=a").callback[name])
    assert str(raised.value) == (
        f"callback.{name}: needs {name}, which is not installed. Try: pip install 'cadam3d[{name}]'"
    )


# --- TensorBoard ------------------------------------------------------------------------------------------


def events(folder: Path):
    """Return what TensorBoard itself reads in a folder of event files."""
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    found = accumulator.EventAccumulator(str(folder), size_guidance={"images": 0, "scalars": 0})
    return found.Reload()


@pytest.fixture(scope="module")
def boarded(tmp_path_factory):
    pytest.importorskip("tensorboard")
    folder = tmp_path_factory.mktemp("board")
    return folder, train(folder, TensorBoard(every=4))


def test_tensorboard_reads_the_numbers_the_pictures_and_the_settings(boarded):
    found = events(boarded[0] / "tensorboard")
    losses = found.Scalars("train/loss")
    assert [each.step for each in losses] == [1, 4, 8, 10]
    assert all(each.value > 0 for each in losses)
    assert [each.step for each in found.Scalars("refine/after")] == [4, 8]
    assert found.Scalars("result/psnr")[0].value == 21.5
    pictures = found.Images("preview")
    assert [(each.step, each.width, each.height) for each in pictures] == [(4, 16, 8), (8, 16, 8)]
    [settings] = found.Tensors("config.yaml/text_summary")
    assert b"    prompt: a red cube\n" in settings.tensor_proto.string_val[0]


def test_the_typed_settings_and_the_final_numbers_are_a_row_of_the_tab_hparams(boarded):
    plugin = pytest.importorskip("tensorboard.plugins.hparams.plugin_data_pb2")
    metadata = events(boarded[0] / "tensorboard").SummaryMetadata("_hparams_/session_start_info")
    start = plugin.HParamsPluginData.FromString(metadata.plugin_data.content).session_start_info
    assert {key: value.string_value for key, value in start.hparams.items()} == {
        "prompt": "a red cube",
        "densifier": "cadam",
    }


def test_tracking_does_not_change_the_run(boarded, alone):
    for name, tensor in alone.gaussians.tensors().items():
        assert torch.equal(tensor, boarded[1].gaussians.tensors()[name]), name


def test_a_resumed_run_replaces_the_steps_after_its_checkpoint_in_tensorboard(tmp_path):
    pytest.importorskip("tensorboard")
    state = train(tmp_path, TensorBoard(every=1), steps=3)
    # This run was killed after step 6, and continues from its checkpoint of step 3.
    shutil.copytree(tmp_path / "tensorboard", tmp_path / "kept")
    ahead = TensorBoard(every=1)
    again = train(tmp_path / "ahead", TensorBoard(every=1), steps=3)
    train(tmp_path / "ahead", ahead, steps=6, state=again)
    for path in (tmp_path / "ahead/tensorboard").iterdir():
        shutil.copy(path, tmp_path / "tensorboard")
    train(tmp_path, TensorBoard(every=1), steps=8, state=state)
    steps = [each.step for each in events(tmp_path / "tensorboard").Scalars("train/loss")]
    assert steps[-5:] == [4, 5, 6, 7, 8]


# --- Weights & Biases -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def without_key(tmp_path_factory):
    """Hide the API keys of this machine, and let every attempt to reach a server fail at once."""
    pytest.importorskip("wandb")
    with pytest.MonkeyPatch.context() as patch:
        for name in [name for name in os.environ if name.startswith("WANDB_")]:
            patch.delenv(name)
        patch.setenv("NETRC", str(tmp_path_factory.mktemp("home") / "netrc"))
        patch.setenv("WANDB_CONFIG_DIR", str(tmp_path_factory.mktemp("config")))
        patch.setenv("WANDB_BASE_URL", "http://127.0.0.1:9")
        patch.setenv("WANDB_ERROR_REPORTING", "false")
        yield


def tracker(**changes) -> Wandb:
    return Wandb(**{"every": 4, "project": "p", "entity": None, "mode": "auto", "timeout": 5, **changes})


def records(path: Path) -> Iterator:
    """Yield what a file of wandb contains: messages in the log format of LevelDB, after 7 bytes."""
    internal = pytest.importorskip("wandb.proto.wandb_internal_pb2")
    content, at, parts = path.read_bytes(), 7, b""
    while at + 7 <= len(content):
        if 32768 - at % 32768 < 7:
            at += 32768 - at % 32768
            continue
        _, length, kind = struct.unpack("<IHB", content[at : at + 7])
        parts += content[at + 7 : at + 7 + length]
        at += 7 + length
        if kind in (1, 4):  # whole, or the last part
            yield internal.Record.FromString(parts)
            parts = b""


def history(path: Path) -> dict[int, set[str]]:
    """Return the names of the numbers of each step in a file of wandb."""
    rows = [record.history for record in records(path) if record.HasField("history")]
    named = [{item.key or "/".join(item.nested_key): item.value_json for item in row.item} for row in rows]
    return {int(row["_step"]): set(row) for row in named}


@pytest.fixture(scope="module")
def offline(without_key, tmp_path_factory):
    """Return the folder of a sweep's job that was tracked, stopped after step 6 and resumed from step 4."""
    sweep = tmp_path_factory.mktemp("sweep")
    (sweep / JOBS).write_text("{}")
    folder = sweep / "job"
    state = train(folder, steps=4)
    train(folder, tracker(every=1), steps=6)
    train(folder, tracker(every=1), steps=8, state=state)
    return folder, state


@pytest.mark.slow
def test_without_a_key_the_run_is_recorded_on_the_disk_and_each_step_once(offline, alone):
    first, second = sorted((offline[0] / "wandb").glob("offline-run-*/*.wandb"))
    before, after = history(first), history(second)
    assert [step for step in before if "train/loss" in before[step]] == [1, 2, 3, 4, 5, 6]
    assert [step for step in after if "train/loss" in after[step]] == [7, 8]
    assert {"preview", "refine/after"} <= before[4]
    assert {"preview", "refine/after"} <= after[8]
    started = [record.run for path in (first, second) for record in records(path) if record.HasField("run")]
    assert len({run.run_id for run in started}) == 1
    assert {run.run_group for run in started} == {offline[0].parent.name}
    config = {item.key: item.value_json for item in started[0].config.update}
    assert config["prompt"] == '"a red cube"'


@pytest.mark.slow
def test_nothing_that_wandb_could_collect_by_itself_is_in_its_files(offline):
    content = b"".join(path.read_bytes() for path in (offline[0] / "wandb").glob("*/*.wandb"))
    assert socket.gethostname().encode() not in content or len(socket.gethostname()) < 4
    for unwanted in (
        b"pytest",
        b"site-packages",
        b"requirements.txt",
        b"output.log",
        b"git",
    ):
        assert unwanted not in content, unwanted
    names = {path.name for path in (offline[0] / "wandb").rglob("*") if path.is_file()}
    assert not names & {"requirements.txt", "wandb-metadata.json", "output.log", "conda-environment.yaml"}


@pytest.mark.slow
def test_the_run_says_how_to_send_it_later(without_key, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    train(tmp_path / "a run", tracker(mode="offline"), steps=1)
    lines = capsys.readouterr().err.splitlines()
    assert (
        "Weights & Biases: nothing is sent (callback.wandb.mode=offline). To send the run later, type:"
        in lines
    )
    assert "  wandb sync 'a run/wandb'" in lines


@pytest.mark.slow
def test_a_server_that_cannot_be_reached_leaves_the_run_offline(without_key, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(wandb_callback, "has_key", lambda: True)
    monkeypatch.setenv("WANDB_API_KEY", "a" * 40)
    assert train(tmp_path, tracker(timeout=2), steps=2).step == 2
    assert "nothing is sent (" in capsys.readouterr().err
    assert len(list(tmp_path.glob("wandb/offline-run-*/*.wandb"))) == 1


def test_a_key_is_found_without_asking_for_one(without_key, monkeypatch):
    monkeypatch.setattr("builtins.input", lambda *_: pytest.fail("asked"))
    assert not has_key()


FOREIGN = [None, "", "[]", '{"id": "../evil", "recorded": 3}', '{"id": "0123456789abcdef"}']


@pytest.mark.parametrize("content", FOREIGN)
def test_a_record_that_this_program_has_not_written_begins_a_new_run(content, tmp_path):
    path = tmp_path / "cadam3d.json"
    if content is not None:
        path.write_text(content)
    name, recorded = known_run(path)
    assert len(name) == 16
    assert recorded == 0


def test_wrong_values_name_their_key():
    with pytest.raises(
        UserError, match=r"^callback\.wandb\.mode: expected one of auto\|offline, got 'online'"
    ):
        tracker(mode="online")
    with pytest.raises(UserError, match=r"^callback\.wandb\.timeout: "):
        tracker(timeout=0)
    with pytest.raises(
        UserError, match=r"^callback\.tensorboard\.every: .* Try: callback\.tensorboard\.every=10"
    ):
        TensorBoard(every=0)
