"""The benchmark of the ray tracers prints one row for each case, on tiny images."""

import sys
from pathlib import Path

import pytest
import torch

from cadam3d.compiled.library import find_compiler

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))
import bench_tracer

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C++ compiler")


def rows(capsys, *words: str) -> list[list[str]]:
    threads = torch.get_num_threads()
    try:
        bench_tracer.main(words)
    finally:
        torch.set_num_threads(threads)
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[1:]]


def test_times_have_a_row_for_each_prompt_size_and_number_of_threads(capsys):
    found = rows(
        capsys, "--prompts", "a cube", "a mug", "--sizes", "4", "6", "--threads", "1", "2", "--repeats", "1"
    )
    assert [row[:5] for row in found[:2]] == [["a cube", "1", "4", "2", "1"], ["a cube", "1", "4", "2", "2"]]
    assert len(found) == 8
    assert all(float(row[-1]) > 0 for row in found)


def test_the_images_agree(capsys):
    found = rows(capsys, "--agreement", "--objects", "cube", "mug", "--sizes", "8", "--views", "1")
    assert [row[0] for row in found] == ["plain", "striped", "checkered", "spotted"]
    assert all(row[1:4] == ["384", "0", "0"] for row in found)
