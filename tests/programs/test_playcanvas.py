"""The engine PlayCanvas shows our files as we do."""

import pytest
from programs.files import VIEW, Case, assert_upright, assert_wrong_axes_fail
from programs.render_elsewhere import Browser

pytestmark = [pytest.mark.oracle, pytest.mark.slow]

# The engine shows the numbers of every file unchanged in a world with +y up. SuperSplat, which is built on
# it, turns them by half a turn first. Like three.js, the engine cuts the faint ends of Gaussians off.
CASES = [
    Case("ply", 0, "+y", 35),
    Case("ply", 3, "+y", 35),
    Case("compressed_ply", 0, "+y", 35),
    Case("compressed_ply", 3, "+y", 35),
    Case("sog", 0, "+y", 35),
    Case("glb", 0, "+y", 35),
    Case("glb", 3, "+y", 35),
]


@pytest.fixture(scope="module")
def draw():
    with Browser.start() as browser:
        yield lambda path: browser.picture("playcanvas.html", path, VIEW)


@pytest.mark.parametrize("case", CASES, ids=str)
def test_our_files_are_upright_and_look_the_same(draw, case, tmp_path):
    assert_upright(draw, case, tmp_path)


@pytest.mark.parametrize("case", [case for case in CASES if case.degree == 0], ids=str)
def test_files_with_the_wrong_axes_are_upside_down(draw, case, tmp_path):
    assert_wrong_axes_fail(draw, case, tmp_path)
