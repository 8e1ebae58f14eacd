"""Packaging: the wheel contains the configuration and works from an empty folder."""

import ast
import os
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parent.parent


# Without network, without an isolated build environment, and in one process.
BUILD = "import sys; from hatchling.build import *; build_sdist(sys.argv[1]); build_wheel(sys.argv[1])"


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    """Return a folder with the source archive and the wheel."""
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-c", BUILD, str(folder)]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.fixture(scope="module")
def wheel(built) -> Path:
    [path] = built.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory) -> Path:
    """Return a folder that contains the files of the wheel and nothing else, as pip would install them."""
    folder = tmp_path_factory.mktemp("site")
    zipfile.ZipFile(wheel).extractall(folder)
    return folder


def run(installed: Path, where: Path, *command: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(installed), "OMP_NUM_THREADS": "1"}
    line = [sys.executable, *command]
    return subprocess.run(line, cwd=where, env=environment, capture_output=True, text=True, check=False)


def test_the_wheel_carries_the_package_with_its_settings_and_nothing_else_of_the_repository(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    here = {f"cadam3d/{path.relative_to(REPOSITORY)}" for path in find("configs", "*.yaml")}
    assert {name for name in names if name.startswith("cadam3d/configs/")} == here
    patterns = ("*.py", "*.pyi", "*.typed", "*.yaml", "*.js", "*.css", "*.html", "*.jinja")
    patterns += ("*.cpp", "*.h", "*.cu", "*.cuh", "*.glb", "catalog.json")
    sources = {str(path.relative_to(REPOSITORY)) for each in patterns for path in find("cadam3d", each)}
    assert {"cadam3d/py.typed", "cadam3d/__init__.pyi", "cadam3d/trainer.py"} <= sources <= names
    assert {name for name in names if name.endswith(".py")} <= sources
    assert {name.split("/")[0] for name in names if ".dist-info" not in name} == {"cadam3d"}
    assert any(name.endswith("licenses/LICENSE") for name in names)
    [entry] = [name for name in names if name.endswith("entry_points.txt")]
    text = zipfile.ZipFile(wheel).read(entry).decode()
    assert text.split() == ["[console_scripts]", "cadam3d", "=", "cadam3d.cli:main"]


def models() -> dict[str, list[Path]]:
    """Return the files of each trained model that comes with the package."""
    folders = sorted(path for path in (REPOSITORY / "cadam3d/models").glob("*") if path.is_dir())
    return {
        folder.name: [path for path in folder.rglob("*") if path.is_file()]
        for folder in folders
        if (folder / "model_index.json").is_file()
    }


def test_the_wheel_carries_the_trained_models(wheel):
    sizes = {each.filename: each.file_size for each in zipfile.ZipFile(wheel).infolist()}
    named = {path.stem for path in find("configs/prior", "*.yaml") if "package:" in path.read_text("utf-8")}
    assert set(models()) == named
    for name, files in models().items():
        inside = {str(path.relative_to(REPOSITORY)) for path in files}
        folder = f"cadam3d/models/{name}"
        assert {f"{folder}/{file}" for file in ("README.md", "vocabulary.json", "model_index.json")} <= inside
        assert inside == {path for path in sizes if path.startswith(f"{folder}/")}
        assert sum(sizes[path] for path in inside) <= 12e6


def test_the_source_archive_carries_what_its_own_tests_read(built):
    [path] = built.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        modes = {member.name.partition("/")[2]: member.mode for member in archive.getmembers()}
    everything = [*find("cadam3d", "*.py"), *find("configs", "*.yaml"), *find("docs", "*.md")]
    everything += [*find("tests", "*.py"), *REPOSITORY.glob("*.md")]
    everything += [path for files in models().values() for path in files]
    names = {str(path.relative_to(REPOSITORY)) for path in everything}
    names |= {"Makefile", "LICENSE", "pyproject.toml", "constraints.txt", "mkdocs.yml", "CITATION.cff"}
    assert names | {".ci/run"} <= set(modes)
    assert modes[".ci/run"] & 0o100


def imports_of(nodes):
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield str(node.module).partition(".")[0]


def test_every_imported_package_is_declared():
    """Core dependencies may be imported at the top of a module, those of an extra only inside functions."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    core = {re.match(r"[\w-]+", line).group() for line in project["dependencies"]}
    optional = project["optional-dependencies"]
    names = ("diffusers", "formats", "gsplat", "notebook", "tensorboard", "texture", "wandb")
    extras = [optional[name] for name in names]
    extra = {re.match(r"[\w-]+", line).group() for lines in extras for line in lines}
    provides = metadata.packages_distributions()
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in find("cadam3d", "*.py")]
    at_top = {name for tree in trees for name in imports_of(tree.body)} - {"gsplat"}  # needed by its plug-in
    anywhere = {name for tree in trees for name in imports_of(ast.walk(tree))}
    for imported, declared in ((at_top, core), (anywhere, core | extra)):
        foreign = imported - set(sys.stdlib_module_names) - {"cadam3d"}
        assert foreign
        # Python 3.11 does not list packages that are a single compiled module, such as xatlas.
        undeclared = {
            name
            for name in foreign
            if not {each.lower().replace("_", "-") for each in provides.get(name, [name])} & declared
        }
        assert not undeclared


def test_the_installed_program_composes_from_an_empty_folder(installed, tmp_path):
    done = run(installed, tmp_path, "-m", "cadam3d", "train", "prompt=a cube", "--cfg", "job")
    assert done.returncode == 0, done.stderr
    assert "prompt: a cube" in done.stdout
    assert not list(tmp_path.iterdir())


def test_the_installed_package_reads_its_own_settings_and_models(installed, tmp_path):
    code = "from cadam3d.settings.options import config_dir; from cadam3d.io.pretrained import MODELS; "
    code += "print(config_dir(), MODELS)"
    done = run(installed, tmp_path, "-c", code)
    package = installed / "cadam3d"
    assert done.stdout.split() == [str(package / "configs"), str(package / "models")], done.stderr


def test_the_package_forbids_no_newer_version():
    """With an upper bound, the package could not be installed beside newer versions."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    for_users = [
        *project["dependencies"],
        *(line for name in extras if name != "dev" for line in extras[name]),
    ]
    assert not [line for line in [project["requires-python"], *for_users] if re.search(r"<|==|~=|!=", line)]


def test_the_projects_own_commands_use_the_tested_versions():
    """Every constraint names a dependency, and ``make`` installs under the constraints."""
    text = (REPOSITORY / "pyproject.toml").read_text(encoding="utf-8")
    constraints = (REPOSITORY / "constraints.txt").read_text(encoding="utf-8").splitlines()
    names = [re.split("[<=>]", line)[0] for line in constraints if line and not line.startswith("#")]
    assert "torch" in names
    assert not [name for name in names if f'"{name}>=' not in text]
    done = subprocess.run(
        ["make", "-n", "-W", "pyproject.toml", "test"],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=True,
    )
    assert "--constraint constraints.txt" in done.stdout


def test_make_demo_says_what_it_installs_and_shows_the_progress():
    done = subprocess.run(
        ["make", "-n", "-W", "pyproject.toml", "demo"],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=True,
    )
    said, _, rest = done.stdout.partition("pip install")
    assert re.search(r"echo .*GB.*minutes", said, re.DOTALL)
    assert "--quiet" not in rest


def test_the_ci_runs_make_test_and_nothing_else():
    script = REPOSITORY / ".ci" / "run"
    assert os.access(script, os.X_OK)
    lines = [line for line in script.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    assert lines == ["set -eu", 'cd "$(dirname "$0")/.."', "exec make test"]


@pytest.mark.parametrize(
    ("goal", "expected"),
    [
        ("demo", 'train prompt="a teddy bear"'),
        ("test", "-m pytest"),
        ("check", '-m "not slow"'),
        ("docs", "-m mkdocs build"),
    ],
)
def test_a_make_target_runs_the_expected_command(goal, expected):
    done = subprocess.run(["make", "-n", goal], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    assert expected in done.stdout


def test_make_refuses_a_python_that_is_too_old_or_too_new(tmp_path):
    (tmp_path / "Makefile").symlink_to(REPOSITORY / "Makefile")
    for name in ("pyproject.toml", "constraints.txt"):
        (tmp_path / name).touch()
    old = tmp_path / "python3.8"
    old.write_text("#!/bin/sh\nexit 1\n", encoding="utf-8")
    old.chmod(0o755)
    done = subprocess.run(
        ["make", "demo", f"PYTHON={old}"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode != 0
    assert "is not Python 3.11, 3.12 or 3.13. Try: make demo PYTHON=python3.12" in done.stdout
    assert not (tmp_path / ".venv").exists()


def find(folder: str, pattern: str) -> list[Path]:
    return [path for path in (REPOSITORY / folder).rglob(pattern) if "__pycache__" not in path.parts]
