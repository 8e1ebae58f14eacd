"""Benchmarks that compare two checkouts measure the one that was named, or refuse it."""

import argparse
import os
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))  # as Python does for a script

from checkouts import HERE, add_base, environment_of, find_trees


def parse(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_base(parser)
    return parser.parse_args(words)


def test_a_folder_without_the_package_is_refused(tmp_path, capsys):
    """Otherwise Python would import the installed package, and compare it with itself."""
    with pytest.raises(SystemExit):
        parse("--base", str(tmp_path))
    error = capsys.readouterr().err
    assert f"expected a checkout of cadam3d, got {tmp_path}. Try: git worktree add {tmp_path} " in error


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


def test_without_a_base_only_this_checkout_is_measured():
    assert find_trees(parse().base) == {"here": HERE}
