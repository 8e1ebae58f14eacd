"""``import cadam3d`` is light, offers every public name, and loads torch as the command line does."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

import cadam3d

REPOSITORY = Path(__file__).parents[2]
HEAVY = {"torch", "numpy", "hydra", "omegaconf", "matplotlib", "scipy", "jaxtyping"}
OPENMP = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")
NAMES = {"Asset", "Callback", "ResultTable", "Run", "Stepper", "UserError"}
NAMES |= {"compose", "evaluate", "load", "sweep", "train"}


def python(code: str, folder: Path = REPOSITORY, **changes: str) -> str:
    """Run ``code`` in a new process that finds modules in ``folder`` first, and return its output."""
    environment = {name: value for name, value in os.environ.items() if name not in OPENMP}
    environment |= {"PYTHONPATH": f"{folder}{os.pathsep}{REPOSITORY}", **changes}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_the_import_loads_nothing_heavy():
    loaded = python("import sys, cadam3d; dir(cadam3d); cadam3d.UserError; print(*sys.modules)").split()
    assert not HEAVY & {name.partition(".")[0] for name in loaded}
    assert "cadam3d.core.errors" in loaded


@pytest.mark.parametrize("name", sorted(NAMES))
def test_a_public_name_is_listed_and_loads(name):
    assert name in dir(cadam3d)
    assert getattr(cadam3d, name).__name__ == name


def test_a_star_import_gives_the_public_names():
    names = {}
    exec("from cadam3d import *", names)
    assert names.keys() - {"__builtins__"} == NAMES


def test_type_checkers_see_the_same_names():
    stub = ast.parse((REPOSITORY / "cadam3d/__init__.pyi").read_text(encoding="utf-8"))
    imported = {
        alias.asname for node in stub.body if isinstance(node, ast.ImportFrom) for alias in node.names
    }
    assert imported == NAMES


# A module that takes the place of torch and records what OpenMP would read.
SHOW = f"print(*[os.environ.get(name) for name in {OPENMP}])"
TORCH = f"import os\n{SHOW}\n"
LOOK = f"import os, cadam3d.api; {SHOW}"


def test_torch_is_loaded_with_threads_that_sleep_and_the_environment_stays(tmp_path):
    (tmp_path / "torch.py").write_text(TORCH)
    assert python(LOOK, tmp_path).split() == ["PASSIVE", "3000", "None", "None"]


def test_the_choice_of_the_user_and_a_loaded_torch_stay(tmp_path):
    (tmp_path / "torch.py").write_text(TORCH)
    assert python(LOOK, tmp_path, OMP_WAIT_POLICY="ACTIVE").split() == ["ACTIVE", "None"]
    assert python(f"import torch; {LOOK}", tmp_path).split() == ["None"] * 4
