"""``cadam3d.train`` gives the bytes of the command line, and leaves the program that calls it as it was."""

import ast
import logging
import os
import shlex
import signal
import threading
from dataclasses import dataclass, field
from pathlib import Path

import hydra
import pytest
import torch
from composed import composed
from omegaconf import OmegaConf

import cadam3d
from cadam3d.api.guest import in_python, literal
from cadam3d.build import component
from cadam3d.settings.line import quoted, text_of
from cadam3d.state import RunContext, StepReport, TrainState

SMALL = ("prior=tiny", "rasterizer=auto", "steps=4", "views=1", "camera.size=8", "initializer.count=20")
SMALL += ("refine.start=0", "refine.end=9", "refine.interval=2", "densifier.min_age=0", "seed=3")
SMALL += ("exporter=[ply]", "metric=[size]", "callback=[checkpoint,metrics]", "callback.checkpoint.every=1")
NASTY = "it's 50% of \"a, cube\" = [red], {x: $HOME} ${seed} \\' 🎈"


@dataclass
class Witness(cadam3d.Callback):
    """Records the steps, and interrupts the program after one of them."""

    interrupts_at: int | None = None
    seen: list[tuple[int, int]] = field(default_factory=list)

    def on_step(self, context: RunContext, state: TrainState, report: StepReport) -> None:
        self.seen.append((report.step, len(state.gaussians)))
        if report.step == self.interrupts_at:
            os.kill(os.getpid(), signal.SIGINT)


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("runs")


@pytest.fixture(scope="module")
def run(place) -> cadam3d.Run:
    return cadam3d.train(NASTY, *SMALL, folder=place / "usual")


def asset_of(run: cadam3d.Run) -> bytes:
    return (run.folder / "asset.ply").read_bytes()


def test_the_bytes_are_those_of_the_command_line(run, type_line):
    done = type_line("train", f"prompt={NASTY}", *SMALL, "hydra.run.dir=line")
    assert done.code == 0, done.err
    line = cadam3d.Run("line")
    assert asset_of(line) == asset_of(run)
    assert line.config == run.config
    words = [(each.folder / ".hydra/overrides.yaml").read_text(encoding="utf-8") for each in (line, run)]
    assert words[0] == words[1]
    assert {path.name for path in line.folder.iterdir()} == {path.name for path in run.folder.iterdir()}


@pytest.mark.parametrize(
    "prompt",
    [NASTY, "'a cube'", '"a cube"', "null", "a=b", "[a,b]", "a\\", "${steps}", "choice(a,b)", " é\n"],
)
def test_a_prompt_may_contain_any_characters(prompt):
    assert text_of(quoted(literal("prompt", prompt), is_sweep=False)) == prompt


def test_a_run_shows_its_numbers(run):
    assert run.config["prompt"] == run.summary["prompt"] == NASTY
    assert run.summary["num_gaussians"] == len(run.asset)
    assert run.metrics[-1]["step"] == 4
    assert {row["kind"] for row in run.metrics} == {"step", "refine"}
    assert run.report.is_file()
    assert f"finished after 4 steps, {len(run.asset)} Gaussians" in repr(run)
    assert repr(cadam3d.Run(run.folder)) == repr(run)


@dataclass(eq=False)
class Chatter(logging.Handler):
    """A handler of the caller, which wants warnings."""

    seen: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__()

    def emit(self, record: logging.LogRecord) -> None:
        self.seen.append(f"{record.levelname} {record.getMessage()}")


def test_the_program_of_the_caller_stays_as_it_was(run, tmp_path, monkeypatch, capfd, process_state):
    """The caller uses Hydra itself, has other modes of torch, and a log of its own."""
    monkeypatch.chdir(tmp_path)
    OmegaConf.register_new_resolver("slug", lambda text: f"my {text}", replace=True)
    handler, root = Chatter(), logging.getLogger()
    # Without the handlers and the level that the command line has left in the process of the tests.
    monkeypatch.setattr(root, "handlers", [handler])
    level, dtype = root.level, torch.get_default_dtype()
    root.setLevel(logging.WARNING)
    torch.set_default_dtype(torch.float64)
    try:
        with hydra.initialize(config_path=None, job_name="mine", version_base="1.2"), torch.no_grad():
            before = process_state()
            again = cadam3d.train(NASTY, *SMALL, "callback=[checkpoint,metrics,progress]", folder="again")
            assert process_state() == before
    finally:
        torch.set_default_dtype(dtype)
        root.setLevel(level)
        OmegaConf.clear_resolver("slug")
    assert asset_of(again) == asset_of(run)
    assert capfd.readouterr() == ("", "")
    # The log of the run has more, but the caller asked for warnings only.
    assert not [line for line in handler.seen if line.startswith("INFO")]
    assert "prompt" in (again.folder / "train.log").read_text(encoding="utf-8")


def test_a_callback_sees_every_step_and_a_thread_trains_in_any_folder(run, place):
    witness, runs, folder = Witness(), [], place / "it's, {my} [folder]"

    def work() -> None:
        runs.append(cadam3d.train(NASTY, *SMALL, callbacks=[witness], folder=folder))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert [step for step, _ in witness.seen] == [1, 2, 3, 4]
    assert witness.seen[-1][1] == len(run.asset)
    assert asset_of(runs[0]) == asset_of(run)
    assert runs[0].folder == folder


def test_an_interrupt_saves_and_the_run_continues_to_the_same_bytes(run, place):
    with pytest.raises(KeyboardInterrupt, match="Everything is saved"):
        cadam3d.train(NASTY, *SMALL, callbacks=[Witness(interrupts_at=2)], folder=place / "interrupted")
    half = cadam3d.Run(place / "interrupted")
    assert half.summary["outcome"] == "interrupted"
    whole = half.resume()
    assert whole.folder == half.folder
    assert whole.summary["outcome"] == "finished"
    assert asset_of(whole) == asset_of(run)


@pytest.mark.parametrize("name", ["1e3", "null"])
def test_a_folder_has_exactly_the_name_that_was_given(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = cadam3d.train("a cube", *SMALL, "steps=1", "exporter=[]", "metric=[]", folder=name)
    assert run.folder == tmp_path / name


def test_a_folder_may_refer_to_settings_and_a_run_in_it_stays(run, place):
    taken = run.folder.with_name("3")
    taken.mkdir()
    (taken / "summary.json").write_text("{}")
    with pytest.raises(cadam3d.UserError, match=r"3 holds summary\.json"):
        cadam3d.train(NASTY, *SMALL, folder=place / "${seed}")


def test_a_run_resumes_itself_only(run):
    with pytest.raises(cadam3d.UserError, match="resume: expected one value"):
        run.resume("resume=elsewhere")


@pytest.mark.parametrize(
    "words",
    [
        ("stesp=3",),
        ("prior=tiny", "densifier.tau_Q=2"),
        ("resume=nowhere",),
        ("hydra.run.dir=taken",),
        ("a word",),
    ],
    ids=lambda words: words[-1],
)
def test_an_error_has_the_text_of_the_command_line_and_a_hint_in_python(words, type_line):
    Path("taken").mkdir()
    Path("taken/summary.json").write_text("{}")
    shown = type_line("train", "prompt=a red cube", *words)
    with pytest.raises(cadam3d.UserError) as caught:
        cadam3d.train("a red cube", *words)
    text, _, hint = shown.message.rpartition("Try: ")
    python, _, typed = str(caught.value).rpartition("Try: ")
    assert python == text
    # The words of the hint are the same, as strings of Python.
    is_page = hint.startswith("cadam3d")
    assert typed == f"in a shell: {hint}" if is_page else ast.literal_eval(f"[{typed}]") == shlex.split(hint)
    assert [path.name for path in Path().iterdir()] == ["taken"]


@pytest.mark.parametrize(
    ("words", "settings", "message"),
    [
        (("a cube", "prompt=a cone"), {}, "prompt: expected one value"),
        (("a cube", "hydra.run.dir=b"), {"folder": "a"}, "hydra.run.dir: expected one value"),
        (("a cube", "--cfg", "job"), {}, "in a shell"),
        (("a cube", "attempts=2"), {}, "in a shell"),
    ],
)
def test_what_only_python_can_get_wrong_is_refused(words, settings, message, without_type_checks):
    with pytest.raises(cadam3d.UserError, match=message):
        cadam3d.train(*words, **settings)


@pytest.mark.parametrize(
    ("line", "call"),
    [
        (("train", "prompt=a 'red' cube", "steps=3"), (("a 'red' cube", "steps=3"))),
        (
            ("train", "--config-dir", "my own", "resume=a run"),
            (None, "--config-dir", "my own", "resume=a run"),
        ),
        (("train", "steps=3"), (..., "steps=3")),
        (("sweep", "prompt=a,b", "exporter=[ply]"), ("prompt=a,b", "exporter=[ply]")),
        (("eval", "metric=[clip]", "run=a run"), ("a run", "metric=[clip]")),
    ],
)
def test_a_line_that_an_error_suggests_is_a_call_in_python(line, call):
    found = ast.parse(in_python(shlex.join(["cadam3d", *line])), mode="eval").body
    assert ast.unparse(found.func) == f"cadam3d.{line[0].replace('eval', 'evaluate')}"
    assert tuple(map(ast.literal_eval, found.args)) == call


@pytest.mark.parametrize("hint", ["another run", "cadam3d's page", "pip install 'x[y]'", "a=b, or df -h"])
def test_other_hints_do_not_change(hint):
    assert in_python(hint) == hint


def test_a_hint_about_an_argument_names_the_argument(run):
    with pytest.raises(cadam3d.UserError, match=r"Try: up='-y'$"):
        cadam3d.load(run.folder / "asset.ply", up="up")
    with pytest.raises(cadam3d.UserError, match=r'Try: "outputs/latest"$'):
        cadam3d.Run("nowhere")


def test_an_object_is_used_and_recorded_and_given_again_when_the_run_continues(place):
    settings = ("densifier.tau_SNR=0", "densifier.tau_Q=0.5")
    words = cadam3d.train("a cube", *SMALL, *settings, folder=place / "words")
    given = component(composed("prompt=a cube", *SMALL, *settings).densifier)
    own = tuple(word for word in SMALL if not word.startswith("densifier"))
    stopping = [Witness(interrupts_at=2)]
    with pytest.raises(KeyboardInterrupt, match=r'cadam3d\.train\(None, "resume=.*"\)'):
        cadam3d.train("a cube", *own, densifier=given, callbacks=stopping, folder=place / "object")
    run = cadam3d.Run(place / "object").resume(densifier=given)
    assert asset_of(run) == asset_of(words) != asset_of(cadam3d.Run(place / "usual"))
    assert run.config | {"resume": None} == words.config
    assert run.summary["densifier"] == "CAdam"
    with pytest.raises(TypeError, match="'densfier', expected one of augmentation, "):
        cadam3d.train("a cube", densfier=given)


def test_a_run_that_has_not_ended_shows_what_it_has(run, tmp_path):
    (tmp_path / "config.yaml").write_bytes((run.folder / "config.yaml").read_bytes())
    begun = cadam3d.Run(tmp_path)
    assert (begun.summary, begun.metrics) == ({}, [])
    assert "not finished" in repr(begun)
    with pytest.raises(cadam3d.UserError, match=r"has no asset\.ply yet"):
        begun.asset  # noqa: B018
