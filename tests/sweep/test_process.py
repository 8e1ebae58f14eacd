"""One job as a process of its own: how it is started, stopped, and what is written down when it ends."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from cadam3d.sweep import process
from cadam3d.sweep.folder import STOP, Plan, PlannedJob, Row, load, write_plan
from cadam3d.sweep.process import run_job

REPOSITORY = Path(__file__).parents[2]
PYTHON = sys.executable


@pytest.fixture
def sweep(tmp_path, stand_in, monkeypatch):
    """Makes the folder of a sweep of one job with this prompt."""
    monkeypatch.setattr(sys, "executable", str(stand_in))
    folder = tmp_path / "a sweep, (1)"
    folder.mkdir()
    (folder / "config.yaml").touch()

    def make(prompt: str, **plan) -> Path:
        job = PlannedJob("cadam", "job_1", [f"prompt='{prompt}'", "seed=3"], {"prompt": prompt, "seed": 3})
        write_plan(
            folder, Plan(**{"cwd": str(tmp_path), "flags": [], "threads": None, "jobs": [job], **plan})
        )
        return folder

    return make


def ended(folder: Path) -> tuple[Row, dict]:
    [row] = load(folder)
    return row, json.loads((row.folder / "job.json").read_text())


@pytest.mark.parametrize(
    ("prompt", "outcome", "message", "code", "has_result"),
    [
        ("a cube", "finished", None, 0, True),
        ("a crowd", "out_of_memory", None, 0, True),
        ("a bug", "failed", "ValueError: one two", 1, False),
        ("a mistake", "failed", "prompt: I know no mistake. Try: a cube", 1, False),
        ("a scancel", "interrupted", "stopped", -signal.SIGTERM, False),
        ("a kill", "killed", "by SIGKILL (out of memory?)", -signal.SIGKILL, False),
    ],
)
def test_however_a_process_ends_is_an_outcome(sweep, prompt, outcome, message, code, has_result):
    folder = sweep(prompt)
    run_job(folder, 0)
    row, end = ended(folder)
    assert (row.outcome, row.summary.get("message"), row.has_result) == (outcome, message, has_result)
    assert end["exit_code"] == code
    assert end["seconds"] > 0


def test_numbers_that_a_killed_run_had_written_stay(sweep):
    folder = sweep("a kill")
    run_job(folder, 0)
    row, _ = ended(folder)
    assert row.summary["num_gaussians"] == 5


def test_what_a_job_says_goes_to_its_folder(sweep, capfd):
    folder = sweep("a cube")
    run_job(folder, 0)
    assert (folder / "job_1/console.txt").read_text() == "at work on a cube\n"
    assert capfd.readouterr() == ("", "")


def test_a_job_gets_its_folder_the_flags_and_the_threads_of_the_plan(sweep, calls, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    folder = sweep("a cube", flags=["--config-dir", "/mine"], threads=2)
    run_job(folder, 0)
    [call] = calls(folder)
    assert call["threads"] == "2"
    assert call["words"] == [
        *("train", "prompt='a cube'", "seed=3", "--config-dir", "/mine"),
        f"hydra.run.dir='{folder}/job_1'",
    ]


def test_a_plan_without_threads_leaves_the_environment_alone(sweep, calls, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    folder = sweep("a cube")
    run_job(folder, 0)
    assert calls(folder)[0]["threads"] == "7"


def test_a_job_with_a_checkpoint_goes_on_from_it(sweep, calls):
    folder = sweep("a kill")
    run_job(folder, 0)
    run_job(folder, 0)
    _, again = calls(folder)
    assert again["words"][1] == f"resume='{folder}/job_1'"
    assert "config.yaml" in again["files"]
    assert "summary.json" not in again["files"]  # a stale one would be taken for the outcome
    assert load(folder)[0].outcome == "finished"


def test_a_job_without_a_checkpoint_starts_in_an_empty_folder(sweep, calls):
    folder = sweep("a bug")
    run_job(folder, 0)
    (folder / "job_1/metrics.jsonl").write_text("of the first attempt")
    run_job(folder, 0)
    assert [call["files"] for call in calls(folder)] == [["console.txt"]] * 2


def test_a_job_with_a_result_is_left_alone(sweep, calls):
    folder = sweep("a cube")
    run_job(folder, 0)
    run_job(folder, 0)
    assert len(calls(folder)) == 1


def test_no_job_starts_in_a_sweep_that_is_being_stopped(sweep, calls):
    folder = sweep("a cube")
    (folder / STOP).touch()
    run_job(folder, 0)
    assert not calls(folder)
    assert load(folder)[0].outcome == "unfinished"


def test_a_running_job_is_asked_to_save_when_the_sweep_is_stopped(sweep):
    folder = sweep("a wait")
    thread = threading.Thread(target=run_job, args=(folder, 0))
    thread.start()
    wait_for(folder / "job_1/waiting")
    (folder / STOP).touch()
    thread.join(timeout=20)
    assert not thread.is_alive()
    row, end = ended(folder)
    assert (row.outcome, row.has_result, end["exit_code"]) == ("interrupted", False, 130)


def start_worker(folder: Path, before: str = "") -> subprocess.Popen:
    """A process as a launcher has them, at work on job 0."""
    code = (
        f"import signal, sys; sys.executable = {sys.executable!r}\n"
        "from pathlib import Path; from cadam3d.sweep.process import run_job\n"
        f"sweep = Path({str(folder)!r})\n{before}\nrun_job(sweep, 0)"
    )
    worker = subprocess.Popen([PYTHON, "-c", code], env={**os.environ, "PYTHONPATH": str(REPOSITORY)})
    wait_for(folder / "job_1/waiting")
    return worker


def test_sigterm_of_a_worker_reaches_its_job(sweep):
    """As Slurm sends it when a job is cancelled. Ctrl-C is left to the process of the sweep."""
    folder = sweep("a wait")
    worker = start_worker(folder)
    worker.send_signal(signal.SIGINT)
    time.sleep(0.5)
    assert worker.poll() is None
    worker.terminate()
    assert worker.wait(20) == 0
    assert load(folder)[0].outcome == "interrupted"


def test_a_launcher_that_announces_the_end_has_its_turn_when_the_job_has_saved(sweep):
    """As submitit does when the time of a Slurm job is up: its handler queues the job again and exits."""
    folder = sweep("a wait")
    outcome = "(sweep / 'job_1/summary.json').read_text()"
    handler = f"signal.signal(signal.SIGUSR2, lambda *_: sys.exit(5 if 'interrupted' in {outcome} else 6))"
    worker = start_worker(folder, handler)
    worker.send_signal(signal.SIGUSR2)
    assert worker.wait(20) == 5
    assert not (folder / "job_1/job.json").exists()  # it will go on


def test_a_job_ends_with_the_process_that_started_it():
    code = "import time; from cadam3d.sweep import process; process._end_with(PARENT); time.sleep(60)"
    job = [sys.executable, "-c", code.replace("PARENT", "__import__('os').getppid()")]
    launch = f"import subprocess, time; print(subprocess.Popen({job!r}).pid, flush=True); time.sleep(60)"
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    worker = subprocess.Popen(
        [sys.executable, "-c", launch], env=environment, stdout=subprocess.PIPE, text=True
    )
    assert worker.stdout is not None
    pid = int(worker.stdout.readline())
    time.sleep(1.5)
    assert Path(f"/proc/{pid}").exists() or not Path("/proc").exists()
    worker.kill()
    worker.communicate()
    deadline = time.monotonic() + 30
    while is_alive(pid):
        assert time.monotonic() < deadline
        time.sleep(0.1)


def test_a_job_does_not_hear_what_is_meant_for_its_launcher(monkeypatch):
    heard = []
    monkeypatch.setattr("cadam3d.sweep.process._end_with", lambda parent: None)
    monkeypatch.setattr("cadam3d.cli.main", lambda: heard.extend(map(signal.getsignal, process.ANNOUNCING)))
    monkeypatch.setattr(sys, "argv", ["to be restored"])
    before = [(number, signal.getsignal(number)) for number in process.ANNOUNCING]
    try:
        process.main(["1", "train", "seed=0"])
        assert heard == [signal.SIG_IGN] * 2
        assert sys.argv == ["cadam3d", "train", "seed=0"]
    finally:
        for number, handler in before:
            signal.signal(number, handler)


def is_alive(pid: int) -> bool:
    status = Path(f"/proc/{pid}/stat")
    try:
        return status.read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_for(path: Path) -> None:
    deadline = time.monotonic() + 30
    while not path.exists():
        assert time.monotonic() < deadline, f"{path.name} never came"
        time.sleep(0.02)
