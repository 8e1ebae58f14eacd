"""What benchmarks share: the named checkout is measured, turns alternate, and ratios are right."""

import argparse
import os
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))  # as Python does for a script

from measuring import HERE, add_base, environment_of, find_trees, in_turns, median, milliseconds


def parse(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_base(parser)
    return parser.parse_args(words)


def test_a_folder_without_the_package_is_refused(tmp_path, capsys):
    """Otherwise Python would import the installed package, and compare it with itself."""
    with pytest.raises(SystemExit):
        parse("--base", str(tmp_path))
    error = capsys.readouterr().err
    assert f"expected a checkout of cadam3d, got {tmp_path}" in error


def test_a_process_imports_the_package_of_its_checkout(tmp_path):
    (tmp_path / "cadam3d").mkdir()
    (tmp_path / "cadam3d" / "__init__.py").touch()
    trees = find_trees(parse("--base", str(tmp_path)).base)
    assert trees == {"base": tmp_path, "here": HERE}
    for tree in trees.values():
        done = subprocess.run(
            [sys.executable, "-c", "import cadam3d; print(cadam3d.__file__)"],
            cwd=os.sep,
            env=environment_of(tree),
            capture_output=True,
            text=True,
            check=True,
        )
        assert Path(done.stdout.strip()).parents[1] == tree


def test_a_planted_delay_shows_in_the_ratio_of_turns_that_alternate():
    order = []

    def work(name: str, seconds: float) -> float:
        order.append(name)
        return milliseconds(lambda: time.sleep(seconds), torch.device("meta"))

    works = {"base": partial(work, "base", 0.02), "here": partial(work, "here", 0.06)}
    found = {name: median(times) for name, times in in_turns(works, 3, warm_up=1).items()}
    assert order == ["base", "here"] * 4
    assert found["here"] / found["base"] == pytest.approx(3, rel=0.3)


def test_medians_are_taken_of_numbers_at_any_depth():
    turns = [{"a": {"b": value}, "name": "x", "none": None} for value in (3.0, 1.0, 2.0)]
    assert median(turns) == {"a": {"b": 2.0}, "name": "x", "none": None}
