"""``cadam3d export ply=... for=PROGRAM`` writes a file that this program shows upright, as we render it."""

import pytest
from programs.files import VIEW, assert_equal, in_browser
from programs.render_elsewhere import Browser, SplatTransform, ours
from programs.snowman import snowman_and_pine

from cadam3d.io.ply import write_ply

pytestmark = [pytest.mark.oracle, pytest.mark.slow]


@pytest.fixture(scope="module")
def browser():
    with Browser.start() as started:
        yield started


# For each target the program, and the floor of the PSNR in dB.
TARGETS = {
    "babylon": ("Babylon.js", 38),
    "playcanvas": ("PlayCanvas", 35),
    "spark": ("Spark", 38),
    "three": ("three.js", 30),
}


@pytest.mark.parametrize("target", TARGETS)
def test_the_file_for_a_program_is_upright_there(browser, target, type_line, tmp_path):
    program, floor_db = TARGETS[target]
    [path] = export_for(target, type_line, tmp_path)
    picture = in_browser(browser, program)(path)
    assert_equal(picture, ours(snowman_and_pine(3), VIEW), floor_db, path)


def test_the_file_for_supersplat_is_upright_there(type_line, tmp_path):
    program = SplatTransform.find()
    [path] = export_for("supersplat", type_line, tmp_path)
    assert_equal(program.picture(path, VIEW), ours(snowman_and_pine(3), VIEW), 40, path)


def export_for(target, type_line, folder):
    write_ply(folder / "snowman.ply", snowman_and_pine(3), up="+z", pad_sh=0)
    result = type_line("export", "ply=snowman.ply", f"for={target}", "output=files")
    assert result.code == 0, result.err
    return [path for path in (folder / "files").iterdir() if path.suffix != ".json"]
