"""The addons of three.js show our files as we do, as far as their renderer allows.

It cuts Gaussians off at two standard deviations, where we cut at an alpha of 1/255, and lowers the opacity
of small ones. This limits the PSNR to 31 dB. Its pictures of two files of the same object must therefore
equal *each other*, which is a stricter test of a file.
"""

import pytest
from programs.files import VIEW, Case, assert_equal, assert_upright, assert_wrong_axes_fail
from programs.render_elsewhere import Browser, RefusedError

pytestmark = [pytest.mark.oracle, pytest.mark.slow]

PLY = {degree: Case("ply", degree, "+y", 30) for degree in (0, 3)}
CASES = [
    *PLY.values(),
    Case("splat", 0, "+y", 30),
    Case("spz", 0, "+y", 30),
    Case("spz", 3, "+y", 30),
]
# PSNR against three's own picture of our PLY; what the formats lose decides.
AGAINST_PLY_DB = {"splat-sh0": 42, "spz-sh0": 42, "spz-sh3": 36}


@pytest.fixture(scope="module")
def browser():
    with Browser.start() as started:
        yield started


@pytest.fixture(scope="module")
def draw(browser):
    # Splats hold colours for the display. By default three.js takes them for linear and brightens them.
    return lambda path: browser.picture("three.html", path, VIEW, colours="linear")


@pytest.fixture(scope="module")
def of_ply(draw, tmp_path_factory):
    folder = tmp_path_factory.mktemp("ply")
    return {degree: draw(case.write(folder, case.upright)) for degree, case in PLY.items()}


@pytest.mark.parametrize("case", CASES, ids=str)
def test_our_files_are_upright_and_look_the_same(draw, case, tmp_path):
    assert_upright(draw, case, tmp_path)


@pytest.mark.parametrize("case", [case for case in CASES if case.degree == 0], ids=str)
def test_files_with_the_wrong_axes_are_upside_down(draw, case, tmp_path):
    assert_wrong_axes_fail(draw, case, tmp_path)


@pytest.mark.parametrize("case", [case for case in CASES if str(case) in AGAINST_PLY_DB], ids=str)
def test_other_files_look_like_the_ply(draw, of_ply, case, tmp_path):
    path = case.write(tmp_path, case.upright)
    assert_equal(draw(path), of_ply[case.degree], AGAINST_PLY_DB[str(case)], path)


def test_a_broken_file_is_refused(draw, tmp_path):
    (tmp_path / "broken.ply").write_bytes(b"ply\n")
    with pytest.raises(RefusedError):
        draw(tmp_path / "broken.ply")
