"""Modules in the current folder are imported neither by the program nor by the processes that it starts."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cadam3d.io.run_folder import TABLE

REPOSITORY = Path(__file__).parent.parent
# Modules of the standard library and of packages that cadam3d and its launchers import.
SHADOWS = (
    *("yaml", "types", "typing", "torch", "numpy", "hydra", "omegaconf", "joblib", "cloudpickle", "pathlib"),
    *("json", "random", "shlex", "pickle", "multiprocessing", "hydra_plugins", "signal", "cadam3d_job"),
)


@pytest.fixture
def folder(tmp_path) -> Path:
    """Return a folder of modules, each of which would add its name to the file ``imported`` and end."""
    folder = tmp_path / "current"
    folder.mkdir()
    code = f"open({str(tmp_path / 'imported')!r}, 'a').write(__name__ + ' ')\nraise SystemExit('planted')\n"
    for name in SHADOWS:
        (folder / f"{name}.py").write_text(code)
    return folder


def run(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"}
    environment.pop("PYTHONSAFEPATH", None)
    done = subprocess.run(
        [sys.executable, *words], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert not (folder.parent / "imported").exists(), (folder.parent / "imported").read_text()
    return done


def test_a_sweep_and_its_workers_and_jobs_ignore_the_modules_of_the_current_folder(folder):
    small = ["steps=1", "initializer.count=10", "camera.size=8", "exporter=[]", "metric=[]", "callback=[]"]
    words = ["prompt=a red cube", "seed=0,1", "rasterizer=auto", *small, "hydra.sweep.dir=sweep"]
    launcher = ["launcher=joblib", "launcher.n_jobs=2"]
    # The first option is how the installed script cadam3d starts.
    run(folder, "-P", "-m", "cadam3d", "sweep", *words, *launcher)
    assert len((folder / "sweep" / TABLE).read_text().splitlines()) == 3


def test_python_m_ignores_them_too_once_python_itself_has_started(folder):
    # Python imports these before the first line of cadam3d runs.
    for name in ("types", "typing", "signal", "pathlib", "random"):
        (folder / f"{name}.py").unlink()
    run(folder, "-m", "cadam3d", "train", "prompt=a red cube", "--cfg", "job")
