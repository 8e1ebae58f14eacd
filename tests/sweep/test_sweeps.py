"""``cadam3d sweep`` from the command line to the table, with a small program in place of training."""

import csv
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from cadam3d import cli
from cadam3d.core.errors import UserError
from cadam3d.io.run_folder import JOBS
from cadam3d.launch import read_line
from cadam3d.report.sweep_page import _commands as commands_of
from cadam3d.settings import compose as settings
from cadam3d.settings import options
from cadam3d.settings.line import read_flags
from cadam3d.sweep import plan, start, table
from cadam3d.sweep.folder import Row, load, read_plan
from cadam3d.sweep.process import run_job
from cadam3d.sweep.table import write_table

REPOSITORY = Path(__file__).parents[2]
PYTHON = sys.executable
TRAIN = """
defaults: [{densifier: cadam}, {hydra: default}, _self_]
published_baseline: {tau_pos: 0.0002, views: sum_norm, grad_multiplier: 1.0}
refine: {interval: 50}
optimizer: {steps: "${steps}"}
prompt: ???
negative_prompt: ''
steps: 5
seed: 0
resume: null
"""


@dataclass(frozen=True)
class Result:
    code: int
    out: str
    err: str


@pytest.fixture(scope="session")
def small_configs(tmp_path_factory) -> Path:
    """Return a folder with the real groups that sweeps need and a train.yaml that composes fast."""
    folder = tmp_path_factory.mktemp("configs")
    for name in ("hydra", "densifier", "grid", "launcher"):
        shutil.copytree(REPOSITORY / "configs" / name, folder / name)
    for path in (REPOSITORY / "configs").glob("*.yaml"):
        shutil.copy(path, folder)
    (folder / "train.yaml").write_text(TRAIN, encoding="utf-8")
    return folder


@pytest.fixture
def hydra_sweep(monkeypatch, capfd, tmp_path, small_configs, stand_in):
    """Type ``cadam3d sweep ...`` in an empty folder, in this process and without its report."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    # The program sets this variable; it is restored after the test.
    monkeypatch.setenv("PYTHONSAFEPATH", "1")
    for module in (settings, options):
        monkeypatch.setattr(module, "config_dir", lambda: small_configs)
    monkeypatch.setattr(sys, "executable", str(stand_in))
    monkeypatch.setattr("cadam3d.report.write_sweep", lambda folder: folder / "report.html")
    monkeypatch.setattr("cadam3d.report.comparison", lambda folder: "")

    def run(*words: str, command: str = "sweep") -> Result:
        monkeypatch.setattr(sys, "argv", ["cadam3d", command, *words])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        captured = capfd.readouterr()
        return Result(int(ended.value.code or 0), captured.out, captured.err)

    return run


@pytest.fixture
def sweep(hydra_sweep, monkeypatch):
    """Do the same with a loop instead of Hydra's multirun, in a third of the time."""

    def run_jobs(name: str, arguments: list[str], _run: Callable) -> None:
        given = dict(line.split("=", 1) for line in arguments if "=" in line)
        folder = Path(given["hydra.sweep.dir"].strip("'"))
        assert (name, arguments[-1]) == ("jobs", "--multirun")
        for number in given["job"].split(","):
            run_job(folder, int(number))
            write_table(folder)

    monkeypatch.setattr(start, "run_hydra", run_jobs)
    return hydra_sweep


def row(number: int, folder: Path, swept: dict | None = None, arm: str = "", **summary) -> Row:
    given = {} if swept is None else swept
    return Row(arm=arm, name="job", overrides=[], swept=given, number=number, folder=folder, summary=summary)


def read_table(folder: Path) -> list[dict[str, str]]:
    with (folder / "sweep.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def only_sweep() -> Path:
    [folder] = Path("multirun").iterdir()
    return folder


# --- one row per job --------------------------------------------------------------------------------------


def test_train_with_a_flag_is_a_sweep(sweep):
    assert sweep("-m", "prompt=a cube", "seed=0,1", command="train").code == 0
    assert [row["seed"] for row in read_table(only_sweep())] == ["0", "1"]


def test_the_table_has_one_row_per_job(hydra_sweep):
    result = hydra_sweep("prompt=a corgi, front view", "densifier=baseline,cadam", "seed=0,1")
    assert result.code == 0, result.err
    rows = read_table(only_sweep())
    assert list(rows[0]) == [
        *("job", "arm", "prompt", "seed", "densifier", "outcome", "num_gaussians", "num_gaussians_initial"),
        *("psnr", "ssim", "seconds", "cpu_seconds", "asset_bytes", "commit", "machine", "threads"),
        *("message", "folder"),
    ]
    assert [(row["densifier"], row["seed"]) for row in rows] == [
        ("baseline", "0"),
        ("baseline", "1"),
        ("cadam", "0"),
        ("cadam", "1"),
    ]
    assert {row["psnr"] for row in rows} == {"20.25"}
    assert all((only_sweep() / row["folder"] / "summary.json").is_file() for row in rows)


def test_without_a_grid_the_arm_is_the_densifier_and_no_folder_is_named_after_it(sweep):
    assert sweep("prompt=a cube", "densifier=baseline,cadam").code == 0
    rows = read_table(only_sweep())
    assert [row["arm"] for row in rows] == ["baseline", "cadam"]
    names = ["a-cube-densifier=baseline_a869c586", "a-cube-densifier=cadam_fd14050b"]
    assert [row["folder"] for row in rows] == names
    # Plans of earlier versions have no arms.
    path = only_sweep() / JOBS
    path.write_text(
        path.read_text().replace('"arm":"cadam"', '"arm":""').replace('"arm": "cadam"', '"arm": ""')
    )
    assert '"arm": ""' in path.read_text()
    assert [row.arm for row in load(only_sweep())] == ["baseline", "cadam"]


def test_a_grid_gives_its_name_and_its_arms(sweep):
    result = sweep("prompt=a cube", "grid=densifiers", "seed=0,1")
    rows = read_table(Path("multirun/densifiers"))
    assert [row["arm"] for row in rows] == ["baseline", "cadam", "none"] * 2
    assert [row["densifier"] for row in rows] == ["baseline", "cadam", "none"] * 2
    assert "[1/6] baseline, seed=0: " in result.out
    # The table in the terminal has no column for the densifier, which follows from the arm.
    assert "densifier" not in result.out.split("job  ")[1].splitlines()[0]


def test_a_grid_may_end_with_the_table_of_the_paper(sweep):
    result = sweep("prompt=a cube", "grid=densifiers", "~grid.arms.none", "+grid.paper_table=true")
    folder = Path("multirun/densifiers")
    table = (folder / "table.md").read_text(encoding="utf-8")
    assert "| cadam - baseline |" in table
    assert result.out.rstrip().endswith(table.rstrip())
    assert {"table.csv", "table.tex"} <= {path.name for path in folder.iterdir()}
    assert sweep("prompt=a cube", "grid=densifiers", "~grid.arms.none").code == 0
    assert not list(folder.glob("table.*"))


def test_failed_and_killed_jobs_are_rows_and_the_other_jobs_still_run(sweep, calls):
    Path("multirun").mkdir()
    result = sweep("prompt=a cube,a mistake,a bug,a kill,a crowd,a ball", "hydra.sweep.dir=multirun/x")
    rows = read_table(Path("multirun/x"))
    outcomes = ["finished", "failed", "failed", "killed", "out_of_memory", "finished"]
    assert [row["outcome"] for row in rows] == outcomes
    assert rows[1]["message"] == "prompt: expected a shape. Try: a cube"
    assert rows[2]["message"] == "ValueError: one two"
    assert rows[3]["message"].startswith("by SIGKILL")
    assert result.code == 1
    assert "3 of 6 jobs without a result (2 failed, 1 killed)" in result.err
    assert f"such as multirun/x/{rows[1]['folder']}." in result.err


def test_the_last_of_several_writers_leaves_the_latest_state(tmp_path, monkeypatch):
    """The table also has the result of a job that ends while the table is being written."""
    before, after = row(0, tmp_path), row(0, tmp_path, outcome="finished")
    states = iter([[before], [after], [after]])
    monkeypatch.setattr(table, "load", lambda folder: next(states))
    assert write_table(tmp_path) == [after]
    assert read_table(tmp_path)[0]["outcome"] == "finished"


# --- the same line again ----------------------------------------------------------------------------------


def test_finished_jobs_are_skipped_and_the_others_run_again(sweep, calls):
    line = ("prompt=a cube", "seed=0,1,2")
    sweep(*line)
    rows = load(only_sweep().resolve())
    (rows[1].folder / "summary.json").unlink()
    result = sweep("seed=range(0,3)", 'prompt="a cube"')  # the same line, written differently
    assert result.code == 0
    assert "3 jobs in " in result.out
    assert "2 with a result" in result.out
    assert "[3/3] cadam, seed=1: 5 Gaussians" in result.out
    assert [call["folder"] for call in calls(only_sweep())] == [row.folder.name for row in (*rows, rows[1])]


def test_a_killed_job_continues_from_its_checkpoint(sweep, calls, small_configs):
    folder = Path("multirun/x")
    folder.mkdir(parents=True)
    config = yaml_of(sweep, "prompt=a kill")
    (folder / "config.yaml").write_text(config)
    line = ("prompt=a kill,a cube", "hydra.sweep.dir=multirun/x")
    assert sweep(*line).code == 1
    assert sweep(*line).code == 0
    assert [call["words"][1].partition("=")[0] for call in calls(folder)] == ["prompt", "prompt", "resume"]


def yaml_of(sweep, *words: str) -> str:
    return sweep(*words, "--cfg", "job", "--resolve", command="train").out


def test_a_narrower_line_finds_the_jobs_of_the_wider_one(sweep, calls):
    sweep("prompt=a cube", "grid=densifiers", "seed=0,1")
    assert sweep("prompt=a cube", "grid=densifiers", "seed=1").code == 0
    assert len(calls(Path("multirun/densifiers"))) == 6
    assert {row["seed"] for row in read_table(Path("multirun/densifiers"))} == {"1"}


def test_other_settings_in_the_same_folder_are_refused_with_the_key(sweep, calls):
    folder = Path("multirun/densifiers")
    sweep("prompt=a cube", "grid=densifiers")
    for row in load(folder):
        (row.folder / "config.yaml").write_text(yaml_of(sweep, "prompt=a cube", row.overrides[1]))
    table = (folder / "sweep.csv").read_bytes()
    assert sweep("prompt=a cube", "grid=densifiers").code == 0
    result = sweep("prompt=a cube", "grid=densifiers", "steps=9")
    assert result.code == 1
    assert result.err.startswith(f"cadam3d: optimizer.steps: expected 5 as in {folder}/baseline_a-cube_")
    assert result.err.endswith(", got 9. Try: hydra.sweep.dir=multirun/densifiers-2\n")
    assert (folder / "sweep.csv").read_bytes() == table
    assert not Path("multirun/densifiers-2").exists()
    assert len(calls(folder)) == 3


def test_a_job_that_failed_may_run_with_other_settings(sweep):
    line = ("prompt=a bug", "grid=densifiers", "~grid.arms.none", "~grid.arms.cadam")
    sweep(*line)
    [row] = load(Path("multirun/densifiers"))
    (row.folder / "config.yaml").write_text("steps: 4")
    assert "1 failed" in sweep(*line, "steps=9").err


def test_a_second_sweep_in_the_folder_of_a_running_one_is_refused(sweep):
    folder = Path("multirun/densifiers")
    folder.mkdir(parents=True)
    with start.locked(folder / ".lock", UserError):
        result = sweep("prompt=a cube", "grid=densifiers")
    assert result.code == 1
    assert f"hydra.sweep.dir: multirun/densifiers is in use by process {os.getpid()} on " in result.err
    assert result.err.endswith("Try: hydra.sweep.dir=multirun/densifiers-2\n")
    assert not (folder / JOBS).exists()
    assert sweep("prompt=a cube", "grid=densifiers").code == 0


# --- prompts of a file ------------------------------------------------------------------------------------


ENTRIES = """
- {name: cube, category: Material, prompt: "a cube, of glass"}
- {name: ball, category: Concept, prompt: a ball, negative_prompt: blurry}
- {name: torus, category: Concept, prompt: "a ${x} torus"}
"""


def test_the_prompts_of_a_file_are_swept_and_their_labels_are_in_the_table(sweep, calls):
    Path("mine.yaml").write_text(ENTRIES, encoding="utf-8")
    result = sweep("prompts=mine.yaml", "seed=0,1")
    assert result.code == 0, result.err
    rows = read_table(only_sweep())
    columns = ("prompt_name", "category", "prompt", "negative_prompt", "seed")
    assert [tuple(row[name] for name in columns) for row in rows] == [
        (name, category, prompt, negative, seed)
        for name, category, prompt, negative in (
            ("cube", "Material", "a cube, of glass", ""),
            ("ball", "Concept", "a ball", "blurry"),
            ("torus", "Concept", "a ${x} torus", ""),
        )
        for seed in "01"
    ]
    assert [row.category for row in load(only_sweep())][::2] == ["Material", "Concept", "Concept"]
    assert only_sweep().name.startswith("mine-seed=0-1_")
    words = calls(only_sweep())[2]["words"]
    assert words[:4] == ["train", "prompt='a ball'", "seed=0", "negative_prompt='blurry'"]


def test_a_longer_file_continues_the_sweep_and_a_changed_entry_is_another_job(sweep, calls):
    Path("mine.txt").write_text("a cube\n")
    assert sweep("prompts=mine.txt").code == 0
    Path("mine.txt").write_text("a cube\na ball\n")
    assert "2 jobs in " in (out := sweep("prompts=mine.txt").out)
    assert ", 1 with a result" in out
    Path("mine.yaml").write_text("- {prompt: a cube, negative_prompt: blurry}")
    assert (
        "with a result"
        not in sweep("prompts=mine.yaml", f"hydra.sweep.dir={only_sweep()}").out.splitlines()[0]
    )
    assert len(calls(only_sweep())) == 3


def test_shards_merge_into_the_whole_sweep_by_copying_their_folders(sweep):
    Path("mine.yaml").write_text(ENTRIES, encoding="utf-8")
    line = ("prompts=mine.yaml", "densifier=cadam")
    for number in (1, 2):
        assert sweep(*line, f"prompts.shard={number}/2").code == 0
    shards = sorted(Path("multirun").iterdir())
    whole, _, suffix = shards[0].name.partition("_shard-")
    assert (suffix, [len(read_table(folder)) for folder in shards]) == ("1-of-2", [1, 2])
    for folder in shards:
        shutil.copytree(folder, f"multirun/{whole}", dirs_exist_ok=True)
    assert f"3 jobs in multirun/{whole}, 3 with a result" in sweep(*line).out
    assert [row["prompt_name"] for row in read_table(Path("multirun", whole))] == ["cube", "ball", "torus"]


@pytest.mark.parametrize(
    ("words", "command", "expected"),
    [
        (("prompts=mine.txt",), "train", "prompts"),
        (
            ("prompts=nope", "seed=0,1"),
            "sweep",
            "expected a file, or one of the sets paper50|shapes6, got 'nope'",
        ),
        (
            ("prompts=shapes6", "prompt=a cube"),
            "sweep",
            "prompts: expected either prompts= or prompt=, got 'both'.",
        ),
    ],
)
def test_a_mistake_about_prompts_is_one_message(words, command, expected, sweep):
    result = sweep(*words, command=command)
    assert result.code == 1
    assert expected in result.err
    assert len(result.err.splitlines()) == 1
    assert not list(Path.cwd().iterdir())


# --- stopping ---------------------------------------------------------------------------------------------


@pytest.fixture
def start_sweep(tmp_path, small_configs, stand_in):
    """Start a sweep in a separate process. Its workers use the replacement of training too."""
    python = tmp_path / "python"
    is_job = 'case "$*" in *cadam3d.job*)'
    python.write_text(f'#!/bin/sh\n{is_job} exec {stand_in} "$@";; esac\nexec {PYTHON} "$@"\n')
    python.chmod(0o755)
    site = tmp_path / "site"
    site.mkdir()
    (site / "sitecustomize.py").write_text(f"import sys; sys.executable = {str(python)!r}")

    def run(*words: str) -> subprocess.Popen:
        code = (
            "import sys; from pathlib import Path; from cadam3d import cli\n"
            "from cadam3d.settings import options, compose as settings\n"
            "for module in (settings, options):\n"
            f"    module.config_dir = lambda: Path({str(small_configs)!r})\n"
            f"sys.argv = {['cadam3d', 'sweep', *words]!r}\n"
            "cli.main()"
        )
        environment = {**os.environ, "PYTHONPATH": f"{site}:{REPOSITORY}", "OMP_NUM_THREADS": "1"}
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        started.append(subprocess.Popen([PYTHON, "-c", code], cwd=tmp_path, env=environment, **pipes))
        return started[-1]

    started: list[subprocess.Popen] = []
    yield run
    # After a failed test, the workers and jobs end together with the process of the sweep.
    for process in started:
        process.kill()
        process.wait()


@pytest.mark.parametrize(("launcher", "running"), [((), 1), (("launcher=joblib", "launcher.n_jobs=2"), 2)])
def test_sigint_stops_all_running_jobs_and_the_table_is_right(launcher, running, start_sweep, tmp_path):
    process = start_sweep("prompt=a wait", "seed=0,1,2,3,4,5", "hydra.sweep.dir=x", *launcher)
    wait_for(tmp_path, "x/*/waiting", process, running)  # they run side by side
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert "Stopping as soon as everything is saved" in err
    assert f"6 of 6 jobs without a result ({running} interrupted, {6 - running} unfinished)" in err
    assert "Traceback" not in err
    outcomes = [row["outcome"] for row in read_table(tmp_path / "x")]
    assert sorted(outcomes) == ["interrupted"] * running + ["unfinished"] * (6 - running)
    assert out.count("interrupted") == 2 * running  # when it ended, and in the table


@pytest.mark.slow
def test_no_job_runs_twice_at_a_time_when_a_killed_sweep_is_started_again(start_sweep, calls, tmp_path):
    launcher, running = ("launcher=joblib", "launcher.n_jobs=2"), 2
    line = ("prompt=a long one", "seed=0,1", "hydra.sweep.dir=x")
    folder = tmp_path / "x"
    first = start_sweep(*line, *launcher)
    wait_for(folder, "*/waiting", first, running)
    first.kill()
    held = [call["folder"] for call in calls(folder)]
    second = start_sweep(*line, *launcher)
    # The pipes close once its workers have ended. Its jobs are still running.
    first.communicate(timeout=30)
    # Each of its own workers reports that it waits for a job.
    for _ in range(running):
        while "waiting for process" not in (line := second.stderr.readline()):
            assert line, second.communicate()
    assert len(calls(folder)) == running
    (folder / "end").touch()
    wait_until(lambda: len(calls(folder)) == 2 * running, second)
    (folder / "go").touch()
    _, err = second.communicate(timeout=60)
    assert second.returncode == 0, err
    times = Counter(call["folder"] for call in calls(folder))
    assert times == {row.folder.name: 1 + (row.folder.name in held) for row in load(folder)}
    assert not any(call["running"] for call in calls(folder))


def wait_for(folder: Path, pattern: str, process: subprocess.Popen, count: int = 1) -> None:
    wait_until(lambda: len(list(folder.glob(pattern))) >= count, process)


def wait_until(condition: Callable[[], bool], process: subprocess.Popen) -> None:
    deadline = time.monotonic() + 90
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.05)


# --- launchers --------------------------------------------------------------------------------------------


def test_joblib_runs_the_whole_sweep_and_a_leading_plus_is_accepted(start_sweep, tmp_path):
    words = (
        "prompt=a cube,a mistake",
        "seed=0,1",
        "hydra.sweep.dir=x",
        "+launcher=joblib",
        "launcher.n_jobs=2",
    )
    out, err = start_sweep(*words).communicate(timeout=90)
    rows = read_table(tmp_path / "x")
    assert [row["outcome"] for row in rows] == ["finished", "finished", "failed", "failed"], err
    assert "[4/4]" in out


@pytest.mark.parametrize(
    ("launcher", "pending", "cores", "threads"),
    [
        ({"n_jobs": 4}, 100, 16, 4),
        ({"n_jobs": 3}, 100, 16, 5),
        ({"n_jobs": -1}, 100, 16, 1),
        ({"n_jobs": -1}, 2, 16, 8),
        ({"n_jobs": -2}, 100, 2, 2),
        ({"n_jobs": 8}, 100, 2, 1),
        ({"n_jobs": 4, "threads": 3}, 100, 16, 3),
        (None, 100, 16, None),
    ],
)
def test_jobs_side_by_side_share_the_cores(launcher, pending, cores, threads, monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: range(cores), raising=False)
    cfg = OmegaConf.create({"launcher": launcher, "hydra": {"launcher": {}}})
    assert start._threads(cfg, pending) == threads
    monkeypatch.setenv("OMP_NUM_THREADS", "5")
    assert start._threads(cfg, pending) is None


def test_after_a_failure_of_the_launcher_the_table_is_right(sweep, monkeypatch):
    def fail(*args, **kwargs):
        raise RuntimeError("a worker was lost\nfor reasons")

    monkeypatch.setattr(start, "run_hydra", fail)
    result = sweep("prompt=a cube", "seed=0,1")
    assert result.code == 1
    assert result.err.splitlines()[0] == "cadam3d: the launcher failed. RuntimeError: a worker was lost"
    assert "2 of 2 jobs without a result (2 unfinished)" in result.err


# --- mistakes ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("densifier=cadam,cadm",), "got 'cadm'. Try: densifier=cadam"),
        (
            ("grid=densifiers", "densifier.tau_Q=0.5", "nonsense.key=1"),
            "arm baseline: nonsense.key: no such setting",
        ),
        (
            ("grid=densifiers", "densifier=none"),
            "densifier: the arms baseline and cadam differ in this setting",
        ),
        (
            ("seed=0,1", "launcher=joblib", "launcher.jobs=2"),
            "launcher.jobs: no such setting. Did you mean launcher.n_jobs",
        ),
        (
            ("seed=0,1", "hydra.run.dir=x"),
            "hydra.run.dir: expected hydra.sweep.dir",
        ),
        (("seed=0,1", "hydra.sweep.dir="), "hydra.sweep.dir: expected a folder"),
        (("seed=0,1", "hydra.sweep.dir=x_${seedd}"), "hydra.sweep.dir: Interpolation key 'seedd' not found"),
        (("steps=7",), "sweep: nothing to sweep over"),
    ],
)
def test_a_mistake_is_one_message_before_anything_runs(words, expected, sweep):
    result = sweep("prompt=a cube", *words)
    assert result.code == 1
    assert expected in result.err
    assert len(result.err.splitlines()) == 1
    assert not list(Path.cwd().iterdir())


def test_a_folder_that_holds_a_run_is_refused(sweep):
    Path("run").mkdir()
    Path("run/summary.json").write_text("{}")
    result = sweep("prompt=a cube", "seed=0,1", "hydra.sweep.dir=run")
    assert result.code == 1
    assert "holds a run. Try: hydra.sweep.dir=run-2" in result.err


@pytest.mark.parametrize("name", ["sweep.csv", "figures"])
def test_a_sweep_overwrites_and_removes_no_files_of_the_user(name, sweep):
    own = Path("mine", name)
    own.parent.mkdir()
    own.mkdir() if "." not in name else own.write_text("my own")
    result = sweep("prompt=a cube", "seed=0,1", "hydra.sweep.dir=mine")
    assert result.code == 1
    assert f"mine holds {name}. Try: hydra.sweep.dir=mine-2" in result.err
    assert [path.name for path in own.parent.iterdir()] == [name]


def test_cfg_job_shows_the_first_job(sweep):
    result = sweep("prompt=a cube", "grid=objectives", "seed=3,4", "~grid.each", "--cfg", "job")
    assert result.code == 0, result.err
    assert "seed: 3" in result.out
    assert "densifier.baseline" in result.out
    assert not list(Path.cwd().iterdir())


# --- plans ------------------------------------------------------------------------------------------------


LINES = (
    ["prompt='a cube'"],
    ["prompt='\\${x}'"],
    ["prompt='a ball'", "steps=7", "densifier.tau_Q=0.5"],
    ["prompt='a cube'", "steps=9", "densifier.tau_Q=0.25"],
    ["prompt='a cube'", "densifier=baseline", "densifier.tau_pos=0.5"],
    ["prompt='a cube'", "densifier=baseline", "densifier.tau_pos=null", "+densifier.extra={a: 1}"],
    ["prompt='a cube'", "densifier=baseline", "densifier.tau_pos=0.25", "+densifier.extra={a: 2}"],
    ["prompt='\\${x}'", "refine.interval=${steps}", "steps=8"],
    ["prompt='a cube'", "refine.interval=3", "steps=8"],
    ["prompt='a cube'", "~refine.interval", "densifier.reset_min_age=1"],
)


def test_settings_changed_after_composing_equal_those_that_hydra_composes(sweep):
    composer = plan.Composer(read_flags([])[0], [])
    for _ in range(2):  # the second time, nothing is composed
        for line in LINES:
            cfg = OmegaConf.to_container(settings.compose(line), resolve=True)
            assert composer.compose(line).values == dict(settings.flatten(cfg)), line


def test_many_jobs_that_differ_in_values_are_composed_once(sweep, monkeypatch):
    counted = []
    original = plan.compose
    monkeypatch.setattr(plan, "compose", lambda *args: counted.append(args) or original(*args))
    line = ["prompt='a cube'", "seed=range(0,30)", "densifier.tau_Q=0.5,0.7"]
    found = plan.read_sweep(read_line("sweep", line)).composed
    assert [job.get("seed") for job in found] == [seed for seed in range(30) for _ in range(2)]
    assert len(counted) == 2  # the sweep and one job


def test_the_plan_records_folder_flags_and_line(sweep, tmp_path):
    own = tmp_path / "own/densifier"
    own.mkdir(parents=True)
    (own / "mine.yaml").write_text("_target_: mypackage.Mine\n", encoding="utf-8")
    result = sweep("--config-dir", "own", "prompt='a cube'", "densifier=mine,none", "hydra.sweep.dir=x")
    assert result.code == 0, result.err
    remembered = read_plan(Path("x"))
    assert remembered.cwd == str(tmp_path)
    assert remembered.flags == ["--config-dir", "own"]
    assert remembered.line == [
        *("--config-dir", "own", "prompt='a cube'", "densifier=mine,none", "hydra.sweep.dir=x")
    ]
    assert [job.swept["densifier"] for job in remembered.jobs] == ["mine", "none"]
    _, *lines = commands_of(remembered).splitlines()
    for line, name in zip(lines, ("mypackage.Mine", "cadam3d.densifier.none.NoGrowth"), strict=True):
        program, command, *words = shlex.split(line)
        typed = read_line(command, words)
        cfg = settings.compose(typed.overrides, command, typed.options)
        assert (program, cfg.densifier["_target_"]) == ("cadam3d", name)


def test_another_config_name_is_for_the_jobs_only(hydra_sweep, calls, small_configs):
    """The sweep itself and its launcher keep their own YAML files."""
    (small_configs / "mine.yaml").write_text(TRAIN.replace("steps: 5", "steps: 6"), encoding="utf-8")
    flag = ["--config-name", "mine"]
    result = hydra_sweep(*flag, "prompt=a cube", "seed=0,1", "hydra.sweep.dir=x")
    assert result.code == 0, result.err
    assert [call["words"][-3:-1] for call in calls(Path("x"))] == [flag] * 2


def test_grids_and_components_are_found_on_a_search_path(sweep, tmp_path):
    for name, text in (
        ("grid/mine.yaml", "arms: {one: {densifier: mine}}"),
        ("densifier/mine.yaml", "_target_: mypackage.Mine\ntau: 1"),
    ):
        path = tmp_path / "own" / name
        path.parent.mkdir(parents=True)
        path.write_text(text, encoding="utf-8")
    line = ("prompt=a cube", "grid=mine", f"hydra.searchpath=[file://{tmp_path}/own]", "densifier.tau=1,2")
    assert sweep(*line).code == 0
    rows = read_table(Path("multirun/mine"))
    assert [(row["arm"], row["densifier"], row["densifier.tau"]) for row in rows] == [
        ("one", "mine", "1"),
        ("one", "mine", "2"),
    ]


def test_preparing_a_sweep_needs_no_torch(start_sweep, tmp_path):
    code = "import sys, cadam3d.launch, cadam3d.commands.sweep; assert 'torch' not in sys.modules"
    subprocess.run([PYTHON, "-c", code], check=True, cwd=REPOSITORY)


# --- a dry run --------------------------------------------------------------------------------------------


def contents(folder: Path) -> dict[str, bytes | None]:
    return {str(path): path.read_bytes() if path.is_file() else None for path in sorted(folder.rglob("*"))}


def test_a_dry_run_lists_the_jobs_and_leaves_nothing_behind(sweep, tmp_path):
    result = sweep("prompt=a cube,a ball", "densifier=baseline,cadam", "dry_run=true")
    assert result.code == 0
    lines = result.out.splitlines()
    assert lines[0].startswith("4 jobs in multirun/")
    assert lines[2].split() == ["job", "arm", "prompt", "state", "folder"]
    assert [line.split("  ")[0] for line in lines[3:7]] == ["0", "1", "2", "3"]
    assert all("to run" in line for line in lines[3:7])
    assert contents(tmp_path) == {}


def test_a_dry_run_refuses_results_with_other_settings_like_the_sweep_itself(sweep, tmp_path):
    sweep("prompt=a cube", "seed=0,1", "hydra.sweep.dir=here")
    for job in (tmp_path / "here").glob("*/summary.json"):
        job.with_name("config.yaml").write_text("steps: 5\n")
    line = ("prompt=a cube", "seed=0,1", "steps=6", "hydra.sweep.dir=here")
    result = sweep(*line, "dry_run=true")
    assert result.code == 1
    assert result.err.endswith("Try: hydra.sweep.dir=here-2\n")
