"""The process of a job: how it is started and stopped, and what is recorded when it ends."""

import errno
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from cadam3d.io.lock import try_lock
from cadam3d.io.run_folder import STOP
from cadam3d.sweep import process
from cadam3d.sweep.folder import Job, Plan, Row, load, write_plan
from cadam3d.sweep.process import run_job

REPOSITORY = Path(__file__).parents[2]
PYTHON = sys.executable


@pytest.fixture
def sweep(tmp_path, stand_in, monkeypatch):
    """Return a function that makes the folder of a sweep of one job with a given prompt."""
    monkeypatch.setattr(sys, "executable", str(stand_in))
    folder = tmp_path / "a sweep, (1)"
    folder.mkdir()
    (folder / "config.yaml").touch()

    def make(prompt: str, **plan) -> Path:
        job = Job("cadam", "job_1", [f"prompt='{prompt}'", "seed=3"], {"prompt": prompt, "seed": 3})
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
        ("a mistake", "failed", "prompt: expected a shape. Try: a cube", 1, False),
        ("a scancel", "interrupted", "stopped", -signal.SIGTERM, False),
        ("a kill", "killed", "by SIGKILL (out of memory?)", -signal.SIGKILL, False),
    ],
)
def test_every_end_of_a_process_is_an_outcome(sweep, prompt, outcome, message, code, has_result):
    folder = sweep(prompt)
    run_job(folder, 0)
    row, end = ended(folder)
    assert (row.outcome, row.summary.get("message"), row.has_result) == (outcome, message, has_result)
    assert end["exit_code"] == code
    assert end["seconds"] > 0


def test_the_console_of_a_job_goes_to_its_folder(sweep, capfd):
    folder = sweep("a cube")
    run_job(folder, 0)
    assert (folder / "job_1/console.txt").read_text() == "training a cube\n"
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


def test_a_checkout_in_the_current_folder_is_found_by_its_jobs(sweep, calls, tmp_path, monkeypatch):
    monkeypatch.setattr(process, "PACKAGE_ROOT", tmp_path)
    monkeypatch.setenv("PYTHONPATH", "mine")
    folder = sweep("a cube")
    run_job(folder, 0)
    assert calls(folder)[0]["path"] == f"{tmp_path}{os.pathsep}mine"


def test_a_job_with_a_checkpoint_continues_from_it(sweep, calls):
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
    (folder / "job_1/frames").mkdir()
    lock = (folder / "job_1/.lock").stat().st_ino
    run_job(folder, 0)
    assert [call["files"] for call in calls(folder)] == [[".lock", "console.txt"]] * 2
    assert (folder / "job_1/.lock").stat().st_ino == lock  # a waiting process must see the same file


def test_no_job_starts_in_a_sweep_that_is_being_stopped(sweep, calls):
    folder = sweep("a cube")
    (folder / STOP).touch()
    run_job(folder, 0)
    assert not calls(folder)
    assert load(folder)[0].outcome == "unfinished"


def test_a_running_job_saves_and_ends_when_the_sweep_is_stopped(sweep):
    folder = sweep("a wait")
    thread = threading.Thread(target=run_job, args=(folder, 0))
    thread.start()
    wait_for(folder / "job_1/waiting")
    (folder / STOP).touch()
    thread.join(timeout=20)
    assert not thread.is_alive()
    row, end = ended(folder)
    assert (row.outcome, row.has_result, end["exit_code"]) == ("interrupted", False, 130)


# --- two workers of the same job --------------------------------------------------------------------------


def start_waiting(folder: Path) -> threading.Thread:
    """Start a second worker of job 0, which waits for the first one."""
    thread = threading.Thread(target=run_job, args=(folder, 0), daemon=True)
    thread.start()
    thread.join(3 * process.POLL_SECONDS)
    assert thread.is_alive()
    return thread


def join(thread: threading.Thread) -> None:
    thread.join(timeout=30)
    assert not thread.is_alive()


def test_two_workers_of_the_same_job_run_it_once(sweep, calls):
    folder = sweep("a long one")
    worker = start_worker(folder)
    waiting = start_waiting(folder)
    (folder / "go").touch()
    assert worker.wait(30) == 0
    join(waiting)
    assert len(calls(folder)) == 1
    assert load(folder)[0].outcome == "finished"


@pytest.mark.parametrize("has_checkpoint", [False, True])
def test_a_job_of_a_killed_worker_runs_again_once_its_process_has_ended(has_checkpoint, sweep, calls):
    folder = sweep("a long one")
    worker = start_worker(folder)
    waiting = start_waiting(folder)
    worker.kill()
    worker.wait()
    if has_checkpoint:  # since the other worker waits
        (folder / "job_1/checkpoints").mkdir()
        (folder / "job_1/checkpoints/step_0000002.pt").touch()
    time.sleep(3 * process.POLL_SECONDS)
    # The process of the first worker is still running, and its files are still there.
    [first] = calls(folder)
    assert (folder / "job_1/waiting").exists()
    (folder / "end").touch()
    wait_until(lambda: len(calls(folder)) == 2)
    (folder / "go").touch()
    join(waiting)
    _, second = calls(folder)
    assert second["words"][1].partition("=")[0] == ("resume" if has_checkpoint else "prompt")
    assert not second["running"], first


def test_a_worker_that_waits_for_a_job_ends_when_the_sweep_is_stopped(sweep, calls):
    folder = sweep("a cube")
    (folder / "job_1").mkdir()
    with process._locked(folder / "job_1", folder / STOP):
        waiting = start_waiting(folder)
        (folder / STOP).touch()
        join(waiting)
    assert not calls(folder)


def test_a_lock_ends_with_the_job_even_if_another_process_inherited_it(tmp_path):
    with process._locked(tmp_path, tmp_path / STOP) as lock:
        left_behind = subprocess.Popen(["sleep", "60"], pass_fds=(lock,))
    try:
        with (tmp_path / ".lock").open("w") as file:
            assert try_lock(file.fileno())
    finally:
        left_behind.kill()
        left_behind.wait()


def test_a_file_system_without_locks_runs_jobs_too(sweep, monkeypatch):
    def refuse(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", refuse)
    folder = sweep("a cube")
    run_job(folder, 0)
    assert load(folder)[0].outcome == "finished"


def test_a_machine_without_unix_locks_and_signals_can_import_every_module():
    """On Windows, these signals are missing and locks use msvcrt."""
    code = (
        "import multiprocessing, signal, subprocess, sys, tempfile, types\n"
        "for name in ('SIGUSR1', 'SIGUSR2', 'SIGKILL'): delattr(signal, name)\n"
        "sys.modules['fcntl'] = None\n"
        "locked = []\n"
        "def locking(fd, mode, count):\n"
        "    if mode == 1 and fd in locked: raise PermissionError\n"
        "    (locked.append if mode == 1 else locked.remove)(fd)\n"
        "sys.modules['msvcrt'] = types.SimpleNamespace(locking=locking, LK_NBLCK=1, LK_UNLCK=2)\n"
        "import cadam3d.job, cadam3d.sweep.start\n"
        "from cadam3d.io.lock import try_lock, unlock\n"
        "file = open(sys.argv[1], 'w')\n"
        "fd = file.fileno()\n"
        "assert [try_lock(fd), try_lock(fd), unlock(fd), try_lock(fd)] == [True, False, None, True]\n"
    )
    place = os.devnull
    subprocess.run([PYTHON, "-c", code, place], check=True, cwd=REPOSITORY)


def test_a_worker_ends_with_the_sweep_only_if_the_sweep_has_started_it(monkeypatch):
    """The sweep starts the workers of joblib. Those of Slurm and Ray are started elsewhere and continue."""
    done = []
    monkeypatch.setattr(process, "end_with", lambda parent: done.append(("watch", parent)))
    process._end_with_sweep()
    assert not done
    monkeypatch.setattr("multiprocessing.parent_process", lambda: SimpleNamespace(pid=os.getppid()))
    process._end_with_sweep()
    assert done.pop() == ("watch", os.getppid())
    gone = subprocess.Popen(["true"])
    gone.wait()
    monkeypatch.setattr("multiprocessing.parent_process", lambda: gone)
    kill = os.kill
    monkeypatch.setattr(os, "kill", lambda pid, number: done.append(number) if number else kill(pid, number))
    process._end_with_sweep()
    assert done == [("watch", os.getppid()), signal.SIGKILL]


# --- signals from outside ---------------------------------------------------------------------------------


def start_worker(folder: Path, before: str = "") -> subprocess.Popen:
    """Start a process that runs job 0, as a launcher does."""
    code = (
        f"import signal, sys; sys.executable = {sys.executable!r}\n"
        "from pathlib import Path; from cadam3d.sweep.process import run_job\n"
        f"sweep = Path({str(folder)!r})\n{before}\nrun_job(sweep, 0)"
    )
    worker = subprocess.Popen([PYTHON, "-c", code], env={**os.environ, "PYTHONPATH": str(REPOSITORY)})
    wait_for(folder / "job_1/waiting")
    return worker


def test_sigterm_of_a_worker_reaches_its_job(sweep):
    """Slurm sends SIGTERM when a job is cancelled. A worker ignores Ctrl-C, which the sweep handles."""
    folder = sweep("a wait")
    worker = start_worker(folder)
    worker.send_signal(signal.SIGINT)
    time.sleep(0.2)
    assert worker.poll() is None
    worker.terminate()
    assert worker.wait(20) == 0
    assert load(folder)[0].outcome == "interrupted"


def test_a_launcher_handles_the_end_of_its_time_once_the_job_has_saved(sweep):
    """The handler of submitit queues a Slurm job again when its time is up, and exits."""
    folder = sweep("a wait")
    outcome = "(sweep / 'job_1/summary.json').read_text()"
    handler = f"signal.signal(signal.SIGUSR2, lambda *_: sys.exit(5 if 'interrupted' in {outcome} else 6))"
    worker = start_worker(folder, handler)
    worker.send_signal(signal.SIGUSR2)
    assert worker.wait(20) == 5
    assert not (folder / "job_1/job.json").exists()  # it will continue


def test_a_job_ends_with_the_process_that_started_it():
    code = "import time; from cadam3d.sweep import process; process.end_with(PARENT); "
    code += "print('ready', flush=True); time.sleep(60)"
    job = [sys.executable, "-c", code.replace("PARENT", "__import__('os').getppid()")]
    launch = f"import subprocess, time; print(subprocess.Popen({job!r}).pid, flush=True); time.sleep(60)"
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    worker = subprocess.Popen(
        [sys.executable, "-c", launch], env=environment, stdout=subprocess.PIPE, text=True
    )
    assert worker.stdout is not None
    pid = int(worker.stdout.readline())
    assert worker.stdout.readline() == "ready\n"
    assert is_alive(pid)
    worker.kill()
    # The job holds the other end of the pipe, so this waits for the job too.
    worker.communicate(timeout=30)
    deadline = time.monotonic() + 30
    while is_alive(pid):
        assert time.monotonic() < deadline
        time.sleep(0.1)


def is_alive(pid: int) -> bool:
    status = Path(f"/proc/{pid}/stat")
    try:
        return status.read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_for(path: Path) -> None:
    wait_until(path.exists)


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)
