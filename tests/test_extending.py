"""The examples in docs/extending.md work as written, from a folder outside the package."""

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest
import torch

from cadam3d.densifier.base import GradientSignal
from cadam3d.io.records import declared

REPOSITORY = Path(__file__).parent.parent
PAGE = (REPOSITORY / "docs" / "extending.md").read_text(encoding="utf-8")
BLOCK = re.compile(r"^`([\w./]+)`:\n\n```\w+\n(.*?)^```$", re.MULTILINE | re.DOTALL)
COMMAND = re.findall(r"^```sh\n(.* train .*)\n```$", PAGE, re.MULTILINE)[0]
# A few steps with small images suffice to show that the new parts are used.
SMALL = "experiment=smoke prior=tiny"

# The command as it is installed, for the sources of this repository. The current folder is not on its path.
PROGRAM = f"""#!{sys.executable}
import sys
sys.path.insert(0, {str(REPOSITORY)!r})
from cadam3d.cli import main
main()
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """Return a folder with every file that the page shows."""
    place = tmp_path_factory.mktemp("stranger")
    for name, content in BLOCK.findall(PAGE):
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_text(content, encoding="utf-8")
    return place


@pytest.fixture(scope="module")
def run(place) -> Path:
    """Run the command of the page and return the run folder."""
    program = place / "bin" / "cadam3d"
    program.parent.mkdir()
    program.write_text(PROGRAM, encoding="utf-8")
    program.chmod(0o755)
    run_line(place, f"{COMMAND} {SMALL}")
    return place / "outputs" / "latest"


def run_line(place: Path, line: str) -> str:
    """Run a line in a shell that finds the program, and return what it prints."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment |= {"PATH": f"{place / 'bin'}{os.pathsep}{os.environ['PATH']}", "OMP_NUM_THREADS": "1"}
    command = ["bash", "-c", line]
    done = subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture
def energy(place, monkeypatch):
    """Build the densifier of the page with the values of its YAML file."""
    monkeypatch.syspath_prepend(str(place))
    from omegaconf import OmegaConf

    from cadam3d.build import component

    yield component(OmegaConf.load(place / "myconfigs/densifier/energy.yaml"))
    for name in [name for name in sys.modules if name.partition(".")[0] == "mypackage"]:
        del sys.modules[name]


def signal(means: torch.Tensor) -> GradientSignal:
    n = len(means)
    return GradientSignal(
        means=means, means2d=torch.zeros(1, n, 2), radii=torch.ones(1, n), height=8, width=8
    )


@pytest.mark.parametrize("command", [["check"], ["format", "--check", "--diff"]], ids=lambda words: words[0])
def test_the_code_of_the_page_passes_our_linter(command, place):
    ruff = shutil.which("ruff", path=sysconfig.get_path("scripts"))
    if ruff is None:
        pytest.skip("ruff is not installed")
    settings = ["--no-cache", "--config", str(REPOSITORY / "pyproject.toml")]
    done = subprocess.run(
        [ruff, *command, *settings, "mypackage"], cwd=place, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_exporter_writes_its_file(run):
    rows = [line.split() for line in (run / "asset.xyz").read_text(encoding="utf-8").splitlines()]
    assert rows
    assert all(len(row) == 6 and all(0 <= int(channel) <= 255 for channel in row[3:]) for row in rows)


def test_the_metric_is_in_the_summary(run):
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    assert 0 <= summary["outliers"] <= 1
    # What the metric declares reaches the files of the run and its report.
    assert declared(summary)["outliers"].is_more_better is False
    assert "Share of outliers" in (run / "report.html").read_text(encoding="utf-8")
    assert summary["densifier"] == "energy"


def test_the_statistic_is_logged_at_each_refinement(run):
    lines = map(json.loads, (run / "metrics.jsonl").read_text(encoding="utf-8").splitlines())
    refinements = [line["statistics"] for line in lines if line["kind"] == "refine"]
    assert refinements
    assert all(numbers["energy_threshold"] >= numbers["energy_median"] >= 0 for numbers in refinements)


def test_the_chart_is_in_the_report(run):
    assert "Gradient energy" in (run / "report.html").read_text(encoding="utf-8")


def test_the_densifier_grows_the_share_that_its_settings_name(energy):
    state = energy.observe(energy.init_state(100, torch.device("cpu")), signal(torch.rand(100, 3)))
    assert energy.select(state, 1, torch.Generator()).sum() == 5


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), 1e30])
def test_a_gradient_that_is_not_finite_leaves_the_state_finite(bad, energy):
    means = torch.ones(4, 3)
    means[1, 2] = bad
    before = energy.observe(energy.init_state(4, torch.device("cpu")), signal(torch.ones(4, 3)))
    after = energy.observe(before, signal(means))
    assert after.energy.isfinite().all()
    assert after.energy[1] == before.energy[1]
    assert (after.energy[[0, 2, 3]] > before.energy[[0, 2, 3]]).all()


def test_the_new_parts_are_in_the_help_and_found_by_their_declarations(place, monkeypatch):
    from cadam3d.settings.help import help_text
    from cadam3d.settings.options import config_dir, option_class
    from cadam3d.settings.output import exporting

    monkeypatch.syspath_prepend(str(place))
    folders = [place / "myconfigs", config_dir()]
    page = help_text("train", ["densifier=energy", "exporter=[xyz]", "metric=[outliers]"], folders)
    for key in ("densifier.share", "exporter.xyz.min_opacity", "metric.outliers.radius"):
        assert key in page
    assert option_class("metric", "outliers", folders).numbers
    assert "exporter=[xyz]" in exporting(["output=mine.xyz"], folders)
    for name in [name for name in sys.modules if name.partition(".")[0] == "mypackage"]:
        del sys.modules[name]


@pytest.mark.slow
def test_a_sweep_and_a_choice_use_the_metric(place, run):
    # ``run`` has written the program.
    small = f"{SMALL} steps=2 camera.size=16 exporter=[] metric=[outliers]"
    flags = f"--config-dir myconfigs {small} hydra.run.dir=both"
    line = f"train prompt='a red torus' attempts=2 select=outliers {flags}"
    choice = run_line(place, f"PYTHONPATH=. cadam3d {line}")
    header = (place / "both/sweep.csv").read_text(encoding="utf-8").splitlines()[0]
    assert "outliers" in header.split(",")
    assert "outliers" in (place / "both/report.html").read_text(encoding="utf-8")
    assert "by share of outliers: seed=" in choice
