"""The folder of a run: one process at a time, nothing overwritten, and nothing left by a refused run."""

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from cadam3d.core.errors import UserError
from cadam3d.io.lock import is_held, locked
from cadam3d.io.occupied import occupied
from cadam3d.io.run_folder import LOCK, occupant
from cadam3d.sweep import process
from cadam3d.trainer import Trainer

REPOSITORY = Path(__file__).parents[2]
SMALL = ["prior=tiny", "prompt=a cube", "rasterizer=auto", "camera.size=8", "views=1", "steps=4"]
SMALL += ["initializer.count=7", "metric=[size]", "exporter=[ply]", "callback.metrics.every=1"]
PROCESSES, ROUNDS = 3, 6


def start(code: str, folder: Path, *words: str) -> subprocess.Popen:
    """Start a process that can be written to and read from."""
    return subprocess.Popen(
        [sys.executable, "-c", code, *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def say(process: subprocess.Popen, text: str) -> None:
    process.stdin.write(text + "\n")
    process.stdin.flush()


RACER = """
import sys
from pathlib import Path
from cadam3d.core.errors import UserError
from cadam3d.io.lock import is_held, locked
from cadam3d.io.occupied import occupied
print("ready", flush=True)
for line in sys.stdin:
    kind, name = line.split()
    resume = Path(name) if kind == "resume" else None
    try:
        with occupied(Path(name), is_chosen=kind != "unnamed", resume=resume) as folder:
            (folder / "config.yaml").open("a").write("begun")
            print("won", folder.name, flush=True)
            sys.stdin.readline()
    except UserError as error:
        print("lost", str(error).splitlines()[0], flush=True)
        sys.stdin.readline()
    print("left", flush=True)
"""


def test_of_processes_that_start_at_the_same_moment_one_gets_the_folder(tmp_path):
    racers = [start(RACER, tmp_path) for _ in range(PROCESSES)]
    try:
        for racer in racers:
            assert racer.stdout.readline() == "ready\n"
        for number in range(ROUNDS):
            for kind in ("fresh", "resume", "unnamed"):
                # A resumed run continues what the fresh one has left.
                name = f"{number}{'-unnamed' if kind == 'unnamed' else ''}"
                for racer in racers:
                    say(racer, f"{kind} {name}")
                answers = [racer.stdout.readline().split(maxsplit=1) for racer in racers]
                won = [answer[1].strip() for answer in answers if answer[0] == "won"]
                if kind == "unnamed":
                    assert sorted(won) == [name, *(f"{name}-{k}" for k in range(2, PROCESSES + 1))]
                else:
                    assert won == [name]
                    lost = [answer[1] for answer in answers if answer[0] == "lost"]
                    assert all("is in use by process" in message for message in lost)
                for racer in racers:
                    say(racer, "go on")
                assert all(racer.stdout.readline() == "left\n" for racer in racers)
    finally:
        for racer in racers:
            racer.kill()
            racer.communicate()


def test_a_second_run_resume_or_sweep_in_the_folder_of_a_run_names_its_process(
    type_line, whole_run, tmp_path
):
    shutil.copytree(whole_run, tmp_path / "run")
    with locked(tmp_path / "run" / LOCK, UserError):
        begun = contents(tmp_path / "run")
        holder = f"run is in use by process {os.getpid()} on {os.uname().nodename} since "
        for words, line in (
            (("train", *SMALL, "hydra.run.dir=run"), "Try: hydra.run.dir=run-2"),
            (("train", "resume=run"), "Try: hydra.run.dir=run-2"),
            (("sweep", *SMALL, "seed=0,1", "hydra.sweep.dir=run"), "Try: hydra.sweep.dir=run-2"),
        ):
            message = type_line(*words).message
            assert words[0] == "sweep" or holder in message
            assert line in message
            assert contents(tmp_path / "run") == begun


def test_a_job_of_a_sweep_and_no_other_run_uses_the_lock_of_the_sweep(type_line, tmp_path, monkeypatch):
    folder = tmp_path / "job"
    folder.mkdir()
    with process._locked(folder, tmp_path / "stop") as lock:
        message = type_line("train", *SMALL, "hydra.run.dir=job").message
        assert f"job is in use by process {os.getpid()} on " in message
        monkeypatch.setenv("CADAM3D_LOCK", str(lock))
        assert type_line("train", *SMALL, "hydra.run.dir=job").code == 0
        # outputs/latest is for single runs.
        assert not (tmp_path / "outputs").exists()
        monkeypatch.delenv("CADAM3D_LOCK")
        assert "job is in use by process" in type_line("train", "resume=job").message


def contents(folder: Path) -> dict[str, bytes | str]:
    return {
        str(path.relative_to(folder)): str(path.readlink()) if path.is_symlink() else path.read_bytes()
        for path in folder.rglob("*")
        if path.is_symlink() or path.is_file()
    }


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory) -> Path:
    """Return a folder with everything that a run, its exporters, its callbacks and eval write."""
    place = tmp_path_factory.mktemp("whole")
    pictures = [
        "exporter=[ply,images,preview,turntable,html]",
        "callback=[checkpoint,metrics,previews,candidates]",
    ]
    sizes = [f"exporter.{name}.size=16" for name in ("images", "preview", "turntable")]
    sizes += [
        "callback.previews.every=2",
        "refine.start=1",
        "refine.interval=1",
        "callback.candidates.every=1",
    ]
    views = [f"exporter.{name}.views=2" for name in ("images", "preview", "turntable")]
    from cadam3d import cli

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        patch.setenv("PYTHONSAFEPATH", "1")
        assert not cli.dispatch(["train", *SMALL, *pictures, *sizes, *views, "hydra.run.dir=run"])
        assert not cli.dispatch(["eval", "run=run", "metric=[size]"])
    return place / "run"


def test_every_file_of_a_run_keeps_fresh_runs_out(whole_run, tmp_path):
    names = {path.name for path in whole_run.iterdir()} - {LOCK}
    assert len(names) >= 15
    for name in names:
        folder = tmp_path / f"with {name}"
        folder.mkdir()
        (folder / name).symlink_to("nowhere")
        assert occupant(folder) == name
        before = contents(folder)
        with pytest.raises(UserError) as refused, occupied(folder, is_chosen=True, resume=None):
            pass
        assert f"holds {name}, which a run would overwrite" in str(refused.value)
        assert contents(folder) == before
        [line] = shlex.split(str(refused.value).rpartition("Try: ")[2])
        assert not Path(line.partition("=")[2]).exists()


def test_a_run_holds_its_lock_and_leaves_files_alone_that_no_run_writes(type_line, tmp_path, monkeypatch):
    def train(*words):
        held.append(is_held(tmp_path / "mine" / LOCK))
        return trained(*words)

    held, trained = [], Trainer.train
    monkeypatch.setattr(Trainer, "train", train)
    names = ("notes.txt", "references/photo.jpg", ".gitignore")
    (tmp_path / "mine/references").mkdir(parents=True)
    for name in names:
        (tmp_path / "mine" / name).write_text("my own")
    assert type_line("train", *SMALL, "hydra.run.dir=mine").code == 0
    assert type_line("train", "resume=mine", "steps=5").code == 0
    assert all((tmp_path / "mine" / name).read_text() == "my own" for name in names)
    assert held == [True, True]
    assert not is_held(tmp_path / "mine" / LOCK)


def link(path: Path) -> None:
    path.symlink_to(path.parents[3] / "victim")


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (os.mkfifo, "train.log"),
        (link, "train.log"),
        (os.mkfifo, ".hydra/config.yaml"),
        (link, "candidates/histograms.jsonl"),
        (link, "checkpoints/x"),
    ],
)
def test_a_resumed_run_follows_no_link_out_and_waits_for_no_pipe(make, name, tmp_path, type_line):
    folder = tmp_path / "deep" / "er" / "run"
    for kind in (".hydra", "checkpoints", "candidates"):
        (folder / kind).mkdir(parents=True)
    (folder / ".hydra/overrides.yaml").write_text("[prompt=a cube]")
    make(folder / name)
    before = sorted(tmp_path.rglob("*"))
    message = type_line("train", f"resume={folder}").message
    assert f"{folder / name}: expected a " in message
    assert sorted(tmp_path.rglob("*")) == before
