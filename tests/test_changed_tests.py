"""``make check`` runs the tests that belong to what has changed, and no others."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))
import changed_tests


@pytest.mark.parametrize(
    ("changed", "test"),
    [
        ("cadam3d/densifier/cadam.py", "tests/densifier/test_cadam.py"),
        ("cadam3d/state.py", "tests/test_trainer.py"),  # imports it
        ("cadam3d/rasterizer/kernels/blend.cuh", "tests/rasterizer/test_cuda.py"),
        ("configs/densifier/cadam.yaml", "tests/densifier/test_cadam.py"),
        ("configs/train.yaml", "tests/test_configs.py"),
        ("docs/extending.md", "tests/test_extending.py"),
        ("README.md", "tests/test_docs.py"),
        ("pyproject.toml", "tests/test_packaging.py"),
        ("scripts/site/pages.py", "tests/test_site.py"),
        ("scripts/rasterizer_bench/check.py", "tests/rasterizer/test_bench_rasterizer.py"),
        ("tests/io/test_ply.py", "tests/io/test_ply.py"),
    ],
)
def test_a_change_selects_the_tests_that_belong_to_it(changed, test):
    assert test in changed_tests.tests_of([changed])


def test_a_change_selects_no_tests_of_other_packages():
    selected = changed_tests.tests_of(["cadam3d/camera/sphere.py"])
    assert not [name for name in selected if name.startswith("tests/prior/")]
    assert changed_tests.tests_of(["LICENSE"]) == ["tests/test_architecture.py", "tests/test_prose.py"]
