"""splat-transform, which has SuperSplat's readers and a renderer of its own, shows our files as we do."""

import pytest
from programs.files import VIEW, Case, assert_upright, assert_wrong_axes_fail
from programs.render_elsewhere import RefusedError, SplatTransform

pytestmark = [pytest.mark.oracle, pytest.mark.slow]

CASES = [
    Case("ply", 0, "-y", 40),
    Case("ply", 3, "-y", 40),
    Case("compressed_ply", 0, "-y", 38),
    Case("compressed_ply", 3, "-y", 38),
    Case("splat", 0, "-y", 38),
    Case("spz", 0, "-y", 38),
    Case("spz", 3, "-y", 36),
]


@pytest.fixture(scope="module")
def draw():
    program = SplatTransform.find()
    return lambda path: program.picture(path, VIEW)


@pytest.mark.parametrize("case", CASES, ids=str)
def test_our_files_are_upright_and_look_the_same(draw, case, tmp_path):
    assert_upright(draw, case, tmp_path)


@pytest.mark.parametrize("case", [case for case in CASES if case.degree == 0], ids=str)
def test_files_with_the_wrong_axes_are_upside_down(draw, case, tmp_path):
    assert_wrong_axes_fail(draw, case, tmp_path)


def test_a_broken_file_is_refused(draw, tmp_path):
    (tmp_path / "broken.ply").write_bytes(b"ply\n")
    with pytest.raises(RefusedError):
        draw(tmp_path / "broken.ply")
