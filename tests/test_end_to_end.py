"""The program as a user runs it: real processes, a real prior, real files."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import imageio.v3 as iio
import pytest

from cadam3d import cli
from cadam3d.core.signals import ENDING
from cadam3d.io.jsonl import read_jsonl
from cadam3d.io.lock import INHERITED
from cadam3d.io.ply import read_ply
from cadam3d.sweep import process as jobs
from cadam3d.sweep import start as starting
from cadam3d.sweep.folder import Row
from cadam3d.sweep.process import run_job

pytestmark = pytest.mark.slow

SMALL = ["prompt=a red cube", "experiment=smoke"]
# The pictures are tested once; they take more time than the training.
BARE = [*SMALL, "exporter=[ply]"]
IMPORTED = "imported.txt"  # lists the modules that a training has loaded
SECONDS = 240  # longest wait for one process


def start(folder: Path, *words: str, **more: str) -> subprocess.Popen:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parents[1]), **more}
    return subprocess.Popen(
        [sys.executable, "-m", "cadam3d", *words],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def run(folder: Path, *words: str, code: int = 0, **more: str) -> tuple[str, str]:
    process = start(folder, *words, **more)
    out, err = process.communicate(timeout=SECONDS)
    assert process.returncode == code, f"exit {process.returncode}\n{out}\n{err}"
    return out, err


@pytest.fixture
def type_in(monkeypatch, capfd) -> Callable[..., tuple[str, str]]:
    """Return a function that runs a line in a folder, in this process."""

    def run_here(folder: Path, *words: str, code: int = 0) -> tuple[str, str]:
        monkeypatch.chdir(folder)
        monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
        monkeypatch.setenv("PYTHONSAFEPATH", "1")
        monkeypatch.setattr(sys, "argv", ["cadam3d", *words])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        out, err = capfd.readouterr()
        assert int(ended.value.code or 0) == code, f"exit {ended.value.code}\n{out}\n{err}"
        return out, err

    return run_here


def wait_for(path: Path, process: subprocess.Popen) -> None:
    deadline = time.monotonic() + SECONDS
    while not path.exists():
        assert process.poll() is None, f"ended before {path.name} was written: {process.communicate()}"
        assert time.monotonic() < deadline, f"{path.name} was not written"
        time.sleep(0.005)


def without_time(lines: list[dict]) -> list[dict]:
    return [{key: value for key, value in line.items() if key != "seconds"} for line in lines]


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """Return a folder in which one small run was trained from its first step to its last."""
    folder = tmp_path_factory.mktemp("user")
    _, err = run(folder, "train", *SMALL, PYTHONPROFILEIMPORTTIME="1")
    (folder / IMPORTED).write_text(err)
    return folder


def test_a_run_leaves_everything_that_the_readme_promises(finished):
    latest = finished / "outputs" / "latest"
    summary = json.loads((latest / "summary.json").read_text())
    promised = "prompt seed steps outcome num_gaussians_initial num_gaussians asset_bytes seconds"
    promised += " cpu_seconds commit machine threads densifier guidance prior rasterizer psnr ssim"
    assert set(promised.split()) <= summary.keys()
    assert summary["outcome"] == "finished"
    assert summary["prompt"] == "a red cube"
    assert (summary["densifier"], summary["guidance"], summary["prior"]) == ("cadam", "sds", "world")
    assert len(read_ply(latest / "asset.ply")) == summary["num_gaussians"]
    assert (latest / "asset.ply").stat().st_size == summary["asset_bytes"]
    assert iio.imread(latest / "preview.png").ndim == 3
    assert len(iio.imread(latest / "turntable.mp4", plugin="FFMPEG")) == 8
    assert "a red cube" in (latest / "report.html").read_text()
    assert read_jsonl(latest / "metrics.jsonl")[-1]["step"] == summary["steps"]


def test_eval_measures_what_train_measured(finished, type_in):
    type_in(finished, "eval", "run=outputs/latest", "metric.fidelity.views=4", "metric.fidelity.size=48")
    latest = finished / "outputs" / "latest"
    evaluation = json.loads((latest / "eval.json").read_text())
    summary = json.loads((latest / "summary.json").read_text())
    for key in ("psnr", "ssim", "num_gaussians", "asset_bytes"):
        assert evaluation[key] == pytest.approx(summary[key], rel=1e-6)


def test_a_run_is_refused_in_a_folder_that_holds_another_one(finished, type_in):
    latest = (finished / "outputs" / "latest").resolve()
    before = (latest / "asset.ply").read_bytes()
    _, err = type_in(finished, "train", *SMALL, f"hydra.run.dir={latest}", "seed=1", code=1)
    assert "which a run would overwrite" in err
    _, err = type_in(finished, "train", f"resume={latest}", "seed=1", code=1)
    assert "seed: expected 0" in err
    assert (latest / "asset.ply").read_bytes() == before


def test_a_run_starts_without_slow_imports(finished):
    imported = (finished / IMPORTED).read_text()
    assert "torch.optim" in imported
    # Progress prints this text after the first step.
    before_second_step = imported.partition(": step 1/")[0]
    assert before_second_step != imported
    for name in ("torch._dynamo", "kornia", "scipy.stats", "matplotlib", "trimesh"):
        assert name not in before_second_step


@pytest.mark.parametrize("number", ENDING)
def test_a_signal_saves_everything_and_prints_how_to_continue(tmp_path, number):
    run_folder = tmp_path / "run"
    words = [*BARE, "steps=4000", f"hydra.run.dir={run_folder}", "callback.checkpoint.every=5"]
    process = start(tmp_path, "train", *words)
    wait_for(run_folder / "checkpoints" / "step_0000005.pt", process)
    process.send_signal(number)
    out, err = process.communicate(timeout=SECONDS)
    assert process.returncode == 128 + number, err
    assert "Traceback" not in err
    summary = json.loads((run_folder / "summary.json").read_text())
    assert summary["outcome"] == "interrupted"
    assert 5 <= summary["steps"] < 4000
    assert len(read_ply(run_folder / "asset.ply")) == summary["num_gaussians"]
    assert f"cadam3d train resume={run_folder.name}" in out


@pytest.mark.parametrize(("guidance", "densifier"), [("ism", "none"), ("gcs", "mcmc")])
def test_objectives_and_densifiers_train(tmp_path, guidance, densifier, type_in):
    words = [*BARE, f"guidance={guidance}", f"densifier={densifier}", "steps=12"]
    out, _ = type_in(tmp_path, "train", *words)
    summary = json.loads((tmp_path / "outputs" / "latest" / "summary.json").read_text())
    assert (summary["guidance"], summary["densifier"]) == (guidance, densifier)
    assert "PSNR" in out


def test_a_mesh_is_listed_among_the_files_of_a_run(tmp_path, type_in):
    mesh = ["exporter=mesh", "exporter.mesh.level=0.05", "exporter.mesh.resolution=16"]
    out, _ = type_in(tmp_path, "train", *SMALL, "prompt=a red torus", "steps=1", *mesh)
    assert "asset_mesh.glb" in out


def test_a_dry_run_on_the_tiny_prior_prints_that_its_result_is_meaningless(tmp_path, type_in):
    words = [*BARE, "prior=tiny", "prompt=anything at all", "steps=2"]
    out, err = type_in(tmp_path, "train", *words)
    assert "Note:" in err
    assert "PSNR" not in out
    type_in(tmp_path, "eval", "run=outputs/latest")
    evaluation = json.loads((tmp_path / "outputs" / "latest" / "eval.json").read_text())
    assert "psnr" not in evaluation
    assert evaluation["num_gaussians"] > 0


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds the process of a job in /proc")
def test_a_sweep_continues_after_a_killed_job_and_the_same_line_completes_it_to_the_byte(
    finished, tmp_path, type_in, request
):
    often = ["callback.checkpoint.every=7", "callback.metrics.every=1"]
    words = [*BARE, "densifier=cadam,none", *often, "hydra.sweep.dir=table"]
    table = tmp_path / "table"
    process = start(tmp_path, "sweep", *words)
    wait_for(table / "jobs.json", process)
    jobs = [table / job["name"] for job in json.loads((table / "jobs.json").read_text())["jobs"]]
    wait_for(jobs[0] / "checkpoints" / "step_0000007.pt", process)
    [child] = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    os.kill(int(child), signal.SIGKILL)
    _, err = process.communicate(timeout=SECONDS)
    assert process.returncode == 1
    assert "1 of 2 jobs without a result (1 killed)" in err
    assert f"table/{jobs[0].name}" in err
    assert [row["outcome"] for row in rows_of(table)] == ["killed", "finished"]
    untouched = (jobs[1] / "summary.json").stat().st_mtime_ns

    request.getfixturevalue("jobs_here")
    type_in(tmp_path, "sweep", *reversed(words))
    assert [row["outcome"] for row in rows_of(table)] == ["finished", "finished"]
    assert (jobs[1] / "summary.json").stat().st_mtime_ns == untouched
    whole = finished / "outputs" / "latest"
    assert (jobs[0] / "asset.ply").read_bytes() == (whole / "asset.ply").read_bytes()
    lines = read_jsonl(jobs[0] / "metrics.jsonl")
    assert [line["step"] for line in lines if line["kind"] == "step"] == list(range(1, 41))
    logged = [line for line in lines if line["kind"] == "refine" or line["step"] in (1, *range(0, 41, 5))]
    assert without_time(logged) == without_time(read_jsonl(whole / "metrics.jsonl"))
    assert {row["prompt"] for row in rows_of(table)} == {"a red cube"}
    assert all(float(row["psnr"]) > 5 and int(row["num_gaussians"]) > 0 for row in rows_of(table))

    _, err = type_in(tmp_path, "sweep", *words, "views=2", code=1)
    assert err.startswith("cadam3d: views: expected 1 as in table/")
    assert err.endswith("Try: hydra.sweep.dir=table-2\n")
    assert not (tmp_path / "outputs").exists()  # outputs/latest is for single runs


@pytest.fixture
def jobs_here(monkeypatch) -> None:
    """Let a sweep run its jobs in this process, which has loaded torch already."""

    def run_jobs(_name: str, arguments: list[str], _run: object) -> None:
        given = dict(word.split("=", 1) for word in arguments if "=" in word)
        for number in given["job"].split(","):
            run_job(Path(given["hydra.sweep.dir"].strip("'")), int(number))

    def run_here(_plan: object, row: Row, _stop: Path, lock: int) -> int:
        monkeypatch.setenv(INHERITED, str(lock))
        words = [f"resume={row.folder}"] if row.has_checkpoint else []
        return cli.dispatch(["train", *words, *row.overrides, f"hydra.run.dir={row.folder}"])

    monkeypatch.setattr(starting, "run_hydra", run_jobs)
    monkeypatch.setattr(jobs, "_wait", run_here)


@pytest.mark.usefixtures("jobs_here")
def test_attempts_are_different_assets_and_the_best_is_linked(tmp_path, type_in):
    """What happens to attempts that are killed is tested with a small program in place of training."""
    words = [*BARE, "metric=[fidelity]", "metric.fidelity.views=1", "attempts=3", "select=psnr", "steps=12"]
    folder = tmp_path / "cube"
    out, _ = type_in(tmp_path, "train", *words, "hydra.run.dir=cube")
    psnr = [json.loads((folder / f"seed={seed}" / "summary.json").read_text())["psnr"] for seed in range(3)]
    assert len(set(psnr)) == 3  # three different assets
    best = psnr.index(max(psnr))
    assert (folder / "best").readlink() == Path(f"seed={best}")
    assert f"by PSNR: seed={best}. " in out
    assert (tmp_path / "outputs" / "latest" / "best" / "asset.ply").is_file()
    assert f"seed={best}. " in (folder / "report.html").read_text()


def rows_of(sweep: Path) -> list[dict[str, str]]:
    with (sweep / "sweep.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_a_mistake_of_a_process_is_one_line_and_exit_code_1(tmp_path):
    _, err = run(tmp_path, "train", "prompt=a red florb", code=1)
    assert err.startswith("cadam3d: prompt: ")
    assert len(err.splitlines()) == 1
    assert not list(tmp_path.iterdir())
