"""TensorBoard and Weights & Biases: what they record, how they continue, and that no run depends on them."""

import os
import struct
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from composed import as_yaml, composed

from cadam3d.build import components
from cadam3d.callback.base import Callback
from cadam3d.callback.previews import Previews
from cadam3d.callback.tensorboard import TensorBoard
from cadam3d.callback.tracking import Tracking
from cadam3d.callback.wandb import Wandb, brings_settings, known_run, refused
from cadam3d.core import checks
from cadam3d.core.console import heard_by
from cadam3d.core.errors import UserError
from cadam3d.io.run_folder import JOBS, occupant
from cadam3d.state import RunContext

PICTURES = ("callback.previews.every=4", "callback.previews.views=2", "callback.previews.size=8")
LINE = ("prompt=a red cube", "refine.interval=4", "callback=[previews]", *PICTURES)
SUMMARY = {"steps": 10, "psnr": 21.5, "outcome": "finished", "num_gaussians": 31, "warnings": []}


def prepare(folder: Path) -> None:
    """Write the files with the settings that a run has before its callbacks start."""
    (folder / ".hydra").mkdir(parents=True, exist_ok=True)
    (folder / "config.yaml").write_text(as_yaml(*LINE))
    (folder / ".hydra/overrides.yaml").write_text("- prompt=a red cube\n- +densifier=cadam\n")


@pytest.fixture(scope="module")
def track(begin):
    """Return a function that trains with trackers and returns the state."""

    def run(folder: Path, *trackers: Tracking, steps: int = 10):
        prepare(folder)
        trainer, state, embedding, context = begin(folder, *LINE, f"steps={steps}")
        trainer.callbacks.extend(trackers)
        trainer.train(state, embedding, context)
        for tracker in trackers:
            tracker.on_result(context, {**SUMMARY, "steps": steps})
        return state

    return run


@pytest.fixture(scope="module")
def context_of(begin):
    """Return a function that returns the context of a run in a folder that no test trains."""

    def make(folder: Path) -> RunContext:
        prepare(folder)
        return begin(folder, *LINE)[3]

    return make


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
def alone(track, tmp_path_factory):
    return track(tmp_path_factory.mktemp("alone"))


# --- what both have in common -----------------------------------------------------------------------------


def test_a_step_has_its_numbers_and_its_preview(track, tmp_path):
    recorder = Recorder()
    track(tmp_path, recorder)
    steps = {call[0]: call[1:] for call in recorder.calls if isinstance(call[0], int)}
    assert list(steps) == [1, 4, 8, 10]
    assert [steps[step][1] for step in steps] == [None, "step_000004.png", "step_000008.png", None]
    assert {"train/loss", "train/num_gaussians", "train/seconds"} <= set(steps[1][0])
    assert {"refine/before", "refine/cloned", "refine/snr_p50"} <= set(steps[8][0])
    results = {"result/steps": 10, "result/psnr": 21.5, "result/num_gaussians": 31}
    assert recorder.calls[-2:] == [("conclude", 10, results), ("close", True)]


def test_a_failing_tracker_does_not_affect_the_run_or_other_trackers(track, tmp_path, alone, capsys):
    broken, sound = Recorder(fails_at=4), Recorder()
    state = track(tmp_path, broken, sound)
    message = capsys.readouterr().err
    assert message.count("Warning: callback.torch has stopped") == 1
    assert "the server is gone" in message
    assert broken.calls[-1][0] == 1
    assert sound.calls[-1] == ("close", True)
    assert torch.equal(state.gaussians.means, alone.gaussians.means)


def test_a_run_that_ends_with_an_error_closes_its_tracker(track, tmp_path, monkeypatch):
    def fail(*_):
        raise ZeroDivisionError

    monkeypatch.setattr(Previews, "on_step", fail)
    recorder = Recorder()
    with pytest.raises(ZeroDivisionError):
        track(tmp_path, recorder)
    assert recorder.calls[1:] == [("close", False)]


@pytest.mark.parametrize("name", ["tensorboard", "wandb"])
def test_no_run_begins_in_a_folder_with_records_of_another_one(name, tmp_path):
    (tmp_path / name).mkdir()
    assert occupant(tmp_path) == name


@pytest.mark.parametrize("name", ["tensorboard", "wandb"])
def test_a_missing_package_names_its_extra(name, monkeypatch):
    monkeypatch.setattr(checks, "find_spec", lambda _: None)
    with pytest.raises(UserError) as raised:
        components(composed(f"callback=[{name}]", "prompt=a").callback, Callback, "callback")
    assert str(raised.value) == (f"callback={name}: needs {name}. Try: pip install '.[{name}]'")


# --- TensorBoard ------------------------------------------------------------------------------------------


def events(folder: Path):
    """Return what TensorBoard itself reads in a folder of event files."""
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    found = accumulator.EventAccumulator(str(folder), size_guidance={"images": 0, "scalars": 0})
    return found.Reload()


@pytest.fixture(scope="module")
def boarded(track, tmp_path_factory):
    pytest.importorskip("tensorboard")
    folder = tmp_path_factory.mktemp("board")
    return folder, track(folder, TensorBoard(every=4))


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


def test_a_resumed_run_replaces_the_steps_after_its_checkpoint_in_tensorboard(context_of, tmp_path):
    pytest.importorskip("tensorboard")
    context = context_of(tmp_path)
    # The run was killed after step 6, and continues from its checkpoint of step 3.
    for begin, end in ((0, 6), (3, 8)):
        board = TensorBoard(every=1)
        board.open(context, begin)
        for step in range(begin + 1, end + 1):
            board.record(step, {"train/loss": 100.0 * begin + step}, None)
        # Nothing is lost in a kill, which closes no file.
        assert events(tmp_path / "tensorboard").Scalars("train/loss")[-1].step == end
        board.close(is_complete=False)
    losses = events(tmp_path / "tensorboard").Scalars("train/loss")
    assert [(each.step, each.value) for each in losses] == [
        *((1, 1), (2, 2), (3, 3)),
        *((4, 304), (5, 305), (6, 306), (7, 307), (8, 308)),
    ]


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
        patch.setenv("WANDB_HTTP_TIMEOUT", "1")  # seconds, during which wandb tries again
        yield


def tracker(**changes) -> Wandb:
    return Wandb(**{"every": 4, "project": "p", "entity": None, "mode": "auto", "timeout": 60, **changes})


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


def written(folder: Path) -> list[Path]:
    """Return the files of wandb in the folder of a run in the order of steps, once they are complete."""
    found = list((folder / "wandb").glob("offline-run-*/*.wandb"))
    end = time.monotonic() + 30
    while not all(any(record.HasField("exit") for record in records(path)) for path in found):
        assert time.monotonic() < end
        time.sleep(0.05)
    return sorted(found, key=lambda path: min(history(path)))


def history(path: Path) -> dict[int, set[str]]:
    """Return the names of the numbers of each step in a file of wandb."""
    rows = [record.history for record in records(path) if record.HasField("history")]
    named = [{item.key or "/".join(item.nested_key): item.value_json for item in row.item} for row in rows]
    return {int(row["_step"]): set(row) for row in named}


@pytest.fixture(scope="module")
def offline(without_key, track, context_of, tmp_path_factory):
    """Track the job of a sweep without a key up to step 8, and resume it from step 4."""
    sweep = tmp_path_factory.mktemp("sweep")
    (sweep / JOBS).write_text("{}")
    folder, said = sweep / "a job", []
    with heard_by(lambda text, level: said.append(text)):
        state = track(folder, tracker(every=1), steps=8)
        again = tracker(every=1)
        again.open(context_of(folder), 4)
        for step in range(5, 11):
            again.record(step, {"train/loss": float(step)}, None)
        again.close(is_complete=True)
    return folder, said, state


@pytest.mark.slow
def test_without_a_key_the_run_is_recorded_on_the_disk_and_each_step_once(offline):
    first, second = written(offline[0])
    before, after = history(first), history(second)
    assert [step for step in before if "train/loss" in before[step]] == [1, 2, 3, 4, 5, 6, 7, 8]
    assert [step for step in after if "train/loss" in after[step]] == [9, 10]
    assert {"preview/path", "refine/after"} <= before[4]
    assert len(list(offline[0].glob("wandb/*/files/media/images/preview_*.png"))) == 2


@pytest.mark.slow
def test_a_run_of_wandb_keeps_its_id_and_has_the_settings_and_the_sweep_as_its_group(offline):
    started = [
        record.run for path in written(offline[0]) for record in records(path) if record.HasField("run")
    ]
    assert len({run.run_id for run in started}) == 1
    assert {run.run_group for run in started} == {offline[0].parent.name}
    assert {run.display_name for run in started} == {"a job"}
    config = {item.key: item.value_json for item in started[0].config.update}
    assert config["prompt"] == '"a red cube"'


@pytest.mark.slow
def test_the_final_numbers_are_in_the_summary_of_wandb(offline):
    first = written(offline[0])[0]
    updates = [record.summary.update for record in records(first) if record.HasField("summary")]
    found = {item.key or "/".join(item.nested_key): item.value_json for update in updates for item in update}
    assert found["result/psnr"] == "21.5"


@pytest.mark.slow
def test_nothing_that_wandb_could_collect_by_itself_is_in_its_files(offline):
    content = b"".join(path.read_bytes() for path in written(offline[0]))
    unwanted = [
        b"pytest",
        b"site-packages",
        b"requirements.txt",
        b"output.log",
        b"git",
        str(Path.cwd()).encode(),
    ]
    assert not [each for each in unwanted if each in content]
    files = list((offline[0] / "wandb").rglob("*"))
    assert not [path for path in files if path.is_symlink()]
    names = {path.name for path in files if path.is_file()}
    assert not names & {"requirements.txt", "wandb-metadata.json", "output.log", "conda-environment.yaml"}


@pytest.mark.slow
def test_the_run_says_that_nothing_is_sent_and_does_not_change(offline, track, tmp_path):
    assert "nothing is sent (there is no API key" in offline[1][0]
    state = track(tmp_path, steps=8)
    assert torch.equal(state.gaussians.means, offline[2].gaussians.means)


@pytest.mark.slow
def test_a_server_that_cannot_be_reached_is_a_reason_to_stay_offline(without_key, monkeypatch):
    monkeypatch.setattr("builtins.input", lambda *_: pytest.fail("asked"))
    assert "no API key" in str(refused())
    monkeypatch.setenv("WANDB_API_KEY", "a" * 40)
    reason = refused()
    assert reason is not None
    assert "\n" not in reason


def test_settings_of_wandb_in_the_folder_of_a_run_are_of_unknown_origin(tmp_path, monkeypatch):
    job = tmp_path / "sweep/job"
    for folder in (tmp_path, job.parent, job):
        (folder / "wandb").mkdir(parents=True)
        (folder / "wandb/settings").write_text("[default]\nbase_url = http://elsewhere\n")
    (job.parent / JOBS).write_text("{}")
    found = []
    for folder in (tmp_path, job.parent, job):
        monkeypatch.chdir(folder)
        found.append(brings_settings(job))
    assert found == [False, True, True]
    (job / "wandb/settings").unlink()
    assert not brings_settings(job)


@pytest.mark.parametrize(
    "content", [None, "", "[]", '{"id": "../evil", "recorded": 3}', '{"id": "0123456789abcdef"}']
)
def test_a_record_that_this_program_has_not_written_begins_a_new_run(content, tmp_path):
    path = tmp_path / "cadam3d.json"
    if content is not None:
        path.write_text(content)
    name, recorded = known_run(path)
    assert len(name) == 16
    assert recorded == 0
