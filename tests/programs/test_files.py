"""Other programs show our files as we do, and files with the wrong axes upside down."""

import pytest
from programs.files import (
    CASES,
    PAGES,
    VIEW,
    assert_equal,
    assert_upright,
    assert_wrong_axes_fail,
    in_browser,
)
from programs.render_elsewhere import Browser, RefusedError, SplatTransform, ours, psnr
from programs.snowman import snowman_and_pine

from cadam3d.io.glb import write_glb

pytestmark = [pytest.mark.oracle, pytest.mark.slow]

ALL = [(program, case) for program, cases in CASES.items() for case in cases]
FLAT = [(program, case) for program, case in ALL if case.degree == 0]
# PSNR in three.js against its own picture of our PLY. Its renderer differs from ours, so this is a stricter
# test of a file. The floors depend on what the formats lose.
AGAINST_PLY_DB = {
    **{"glb-sh0": 45, "glb-sh3": 45, "splat-sh0": 42, "spz-sh0": 42, "spz-sh3": 36},
    **{"spz4-sh0": 42, "spz4-sh3": 36, "ksplat-sh0": 42},
}


def each(pairs):
    """Run a test for each program and case."""
    return pytest.mark.parametrize(
        ("program", "case"), [pytest.param(*pair, id=f"{pair[0]}-{pair[1]}") for pair in pairs]
    )


@pytest.fixture(scope="module")
def browser():
    with Browser.start() as started:
        yield started


@pytest.fixture(scope="module")
def splat_transform():
    return SplatTransform.find()


@pytest.fixture
def draw(program, request):
    """Return a function that opens a file in ``program``."""
    if program in PAGES:
        return in_browser(request.getfixturevalue("browser"), program)
    return lambda path: request.getfixturevalue("splat_transform").picture(path, VIEW)


@pytest.fixture(scope="module")
def of_ply(browser, tmp_path_factory):
    """Return the pictures of our PLY in three.js, by SH degree."""
    folder = tmp_path_factory.mktemp("ply")
    plys = [case for case in CASES["three.js"] if case.format == "ply"]
    return {case.degree: in_browser(browser, "three.js")(case.write(folder, case.upright)) for case in plys}


@each(ALL)
def test_our_files_are_upright_and_look_the_same(draw, case, tmp_path):
    assert_upright(draw, case, tmp_path)


@each(FLAT)
def test_files_with_the_wrong_axes_are_upside_down(draw, case, tmp_path):
    assert_wrong_axes_fail(draw, case, tmp_path)


@each(("three.js", case) for case in CASES["three.js"] if str(case) in AGAINST_PLY_DB)
def test_other_files_look_like_the_ply_in_three_js(draw, of_ply, case, tmp_path):
    path = case.write(tmp_path, case.upright)
    assert_equal(draw(path), of_ply[case.degree], AGAINST_PLY_DB[str(case)], path)


def test_linear_colours_are_right_in_three_js_without_a_setting(browser, tmp_path):
    gaussians = snowman_and_pine(3)
    for colors, floor_db, top_db in (("linear", 23, 40), ("display", 10, 20)):
        write_glb(tmp_path / f"{colors}.glb", gaussians, up="+y", colors=colors)
        picture = browser.picture("three.html", tmp_path / f"{colors}.glb", VIEW)
        assert_equal(picture, ours(gaussians, VIEW), floor_db, tmp_path / f"{colors}.glb")
        assert psnr(picture, ours(gaussians, VIEW)) < top_db


@pytest.mark.parametrize("program", ["Spark", "SuperSplat", "three.js"])
def test_a_broken_file_is_refused(draw, tmp_path):
    (tmp_path / "broken.ply").write_bytes(b"ply\n")
    with pytest.raises(RefusedError):
        draw(tmp_path / "broken.ply")
