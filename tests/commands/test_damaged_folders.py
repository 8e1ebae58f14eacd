"""Each file of a finished run is damaged in each of several ways, and each command still ends by itself.

A command either succeeds or prints one message. It never waits for a pipe and never shows a traceback. The
readers of the files are tested with all damages. A command takes a third of a second, so it is tested with a
few damages of each file.
"""

import json
import os
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import yaml

from cadam3d import cli
from cadam3d.core.errors import UserError
from cadam3d.io.checkpoint import load_checkpoint
from cadam3d.io.declarations import read_declarations
from cadam3d.io.jsonl import truncate_after
from cadam3d.io.ply import holds_gaussians, read_ply
from cadam3d.io.reading import read_text
from cadam3d.io.records import read_config, read_histograms, read_metrics, read_summary
from cadam3d.settings.trust import read_overrides

pytestmark = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")

SECONDS = 60  # that a command may take on a busy machine
TINY = ["prompt=a red cube", "prior=tiny", "rasterizer=auto", "camera.size=8", "steps=4", "views=1"]
TINY += ["initializer.count=7", "metric=[size]", "callback=[checkpoint,metrics,candidates]"]
TINY += ["callback.checkpoint.every=2", "callback.candidates.every=1", "callback.candidates.size=8"]
TINY += ["refine.start=0", "refine.end=4", "refine.interval=2", "exporter=[ply]", "hydra.run.dir=run"]
DAMAGES: dict[str, Callable[[Path], object]] = {
    "missing": lambda path: None,
    "empty": lambda path: path.write_bytes(b""),
    "noise": lambda path: path.write_bytes(bytes(range(256)) * 8),
    "cut": lambda path: path.write_bytes(SOUND[path.name][: len(SOUND[path.name]) // 2]),
    "nested": lambda path: path.write_text("[" * 100_000),
    "another kind": lambda path: path.write_text("[1, null]"),
    "wrong values": lambda path: path.write_text(wrong_values(path.name)),
    "a pipe": lambda path: os.mkfifo(path, 0o600),
    "a folder": lambda path: path.mkdir(),
    "a device": lambda path: path.symlink_to("/dev/zero"),
    "a circle": lambda path: path.symlink_to(path.name),
}
SOUND: dict[str, bytes] = {}  # the content of each file of the run, by name


def wrong_values(name: str) -> str:
    """Return JSON in the form of the file with every value replaced by text, as a list, and as a number."""
    if not name.endswith((".json", ".jsonl")):
        return "prompt: [1]\nprior: 7\nrasterizer: {_target_: [x]}\nsteps: {a: b}\n"
    lines = SOUND[name].decode().splitlines() if name.endswith("l") else [SOUND[name].decode()]
    found = []
    for line in lines:
        value = json.loads(line)
        keys = value if isinstance(value, dict) else {}
        found += [json.dumps(value | {key: wrong}) for key in keys for wrong in ("x", [-1], -1e300, True)]
    return "\n".join(found)


def ended(*words: str) -> int:
    """Run a command line in this process and return its exit code; an exception is not caught."""
    sys.argv = ["cadam3d", *words]
    try:
        cli.main()
    except SystemExit as end:
        return int(end.code or 0)
    raise AssertionError("the program always exits")


@contextmanager
def guard() -> Iterator[None]:
    """Raise ``TimeoutError`` in the block if it takes too long."""

    def raise_timeout(*_: object) -> None:
        raise TimeoutError("the command waits")

    assert threading.current_thread() is threading.main_thread()
    previous = signal.signal(signal.SIGALRM, raise_timeout)
    signal.alarm(SECONDS)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, previous)


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """Return the folder of a finished run, which tests copy."""
    place = tmp_path_factory.mktemp("finished")
    before, argv = Path.cwd(), sys.argv
    os.chdir(place)
    try:
        assert ended("train", *TINY) == 0
    finally:
        os.chdir(before)
        sys.argv = argv
    for path in (place / "run").rglob("*"):
        if path.is_file():
            SOUND[path.name] = path.read_bytes()
    return place / "run"


READERS: dict[str, Callable[[Path], object]] = {
    "asset.ply": lambda run: holds_gaussians(run / "asset.ply") and read_ply(run / "asset.ply"),
    "charts.json": read_declarations,
    "config.yaml": lambda run: read_config(run / "config.yaml"),
    "metrics.jsonl": lambda run: (read_metrics(run), truncate_after(run / "metrics.jsonl", 2)),
    "summary.json": read_summary,
    "report.html": lambda run: read_text(run / "report.html"),
    ".hydra/overrides.yaml": lambda run: read_overrides(run / ".hydra/overrides.yaml"),
    "checkpoints/step_0000004.pt": lambda run: load_checkpoint(run / "checkpoints/step_0000004.pt"),
    "candidates/histograms.jsonl": read_histograms,
}
COMMANDS = {
    "eval": ["eval", "run=run", "metric=[size]"],
    "view": ["view", "run=run", "open=false"],
    "render": ["render", "run=run", "exporter=[images]", "exporter.images.size=8", "exporter.images.views=1"],
    "resume": ["train", "resume=run"],
}
# Each line is a file, a damage and a command that reads or replaces the file. Render stands for export, which
# opens an asset in the same way.
CASES = [
    ("asset.ply", "cut", "eval"),
    ("asset.ply", "a pipe", "render"),
    ("charts.json", "wrong values", "resume"),
    ("config.yaml", "nested", "eval"),
    ("config.yaml", "missing", "resume"),
    ("metrics.jsonl", "wrong values", "resume"),
    ("metrics.jsonl", "a device", "resume"),
    ("summary.json", "a folder", "resume"),
    ("report.html", "a folder", "view"),
    ("report.html", "a pipe", "resume"),
    (".hydra/overrides.yaml", "noise", "resume"),
    (".hydra/overrides.yaml", "a circle", "resume"),
    ("checkpoints/step_0000004.pt", "empty", "resume"),
    ("candidates/histograms.jsonl", "another kind", "resume"),
]


def damage_copy(finished: Path, name: str, damage: str) -> None:
    """Replace the folder ``run`` by a copy of the finished run in which one file is damaged."""
    shutil.rmtree("run", ignore_errors=True)
    shutil.copytree(finished, "run")
    path = Path("run", name)
    assert path.is_file(), name
    path.unlink()
    DAMAGES[damage](path)


@pytest.mark.parametrize("name", READERS)
def test_a_reader_returns_something_or_raises_a_message(name, finished, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    READERS[name](finished)
    for damage in DAMAGES:
        damage_copy(finished, name, damage)
        message = "Try: "
        with guard():
            try:
                READERS[name](Path("run"))
            except UserError as error:
                message = str(error)
        assert "Try: " in message, damage


def test_the_cases_include_each_file_damage_and_command():
    assert [set(column) for column in zip(*CASES, strict=True)] == [set(READERS), set(DAMAGES), set(COMMANDS)]


@pytest.mark.parametrize(("name", "damage", "command"), CASES)
def test_a_damaged_file_is_one_message_or_does_not_matter(
    name, damage, command, finished, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    monkeypatch.setattr(sys, "argv", ["cadam3d"])
    monkeypatch.setattr("cadam3d.live.server.Server.serve_forever", lambda self: None)
    damage_copy(finished, name, damage)
    with guard():
        code = ended(*COMMANDS[command])
    captured = capsys.readouterr()
    assert code in (0, 1), captured.err
    assert "Traceback" not in captured.err
    messages = [line for line in captured.err.splitlines() if line.startswith("cadam3d: ")]
    assert len(messages) == code, captured.err
    assert all("Try: " in line for line in messages), captured.err


def test_a_damaged_newest_checkpoint_is_left_out_with_a_note(finished, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["cadam3d"])
    shutil.copytree(finished, "run")
    newest = Path("run/checkpoints/step_0000004.pt")
    newest.unlink()
    shutil.copy("run/checkpoints/step_0000002.pt", newest)
    assert ended("train", "resume=run") == 0
    notes = [line for line in capsys.readouterr().err.splitlines() if "left out" in line]
    assert len(notes) == 1
    assert "step_0000004.pt" in notes[0]
    assert "step: expected the step in its name, got 2" in notes[0]
    lines = [json.loads(line) for line in Path("run/metrics.jsonl").read_text().splitlines()]
    assert lines[-1]["step"] == 4


def test_a_run_cannot_resume_beyond_its_last_step(finished, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["cadam3d"])
    shutil.copytree(finished, "run")
    assert ended("train", "resume=run", "steps=3") == 1
    assert "steps: expected at least 4" in capsys.readouterr().err


def test_a_run_resumes_without_the_file_that_it_began_with(finished, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["cadam3d"])
    shutil.copytree(finished, "run")
    path = Path("run/.hydra/overrides.yaml")
    words = [word for word in yaml.safe_load(path.read_text()) if not word.startswith("initializer.")]
    path.write_text(yaml.safe_dump([*words, "initializer=ply", "initializer.path=moved.ply"]))
    assert ended("train", "resume=run") == 0, capsys.readouterr().err
