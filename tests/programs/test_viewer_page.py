"""Our own page ``viewer.html`` shows in a browser what our rasterizer renders."""

import pytest
from programs.files import VIEW, assert_equal
from programs.render_elsewhere import Browser, ours, psnr, turned
from programs.snowman import snowman_and_pine

from cadam3d.core.gaussians import Gaussians
from cadam3d.exporter.html import HtmlExporter

pytestmark = [pytest.mark.oracle, pytest.mark.slow]

EXPORTER = HtmlExporter(title="A snowman", azimuth_deg=30.0, elevation_deg=15.0, background=[1.0, 1.0, 1.0])


@pytest.fixture(scope="module")
def draw():
    with Browser.start(needs_packages=False) as browser:
        yield lambda path: browser.picture_of_viewer(path, VIEW)


def write(gaussians: Gaussians, folder):
    def never(cameras, background):
        raise AssertionError("the page needs no picture")

    [path] = EXPORTER.export(gaussians, never, folder)
    return path


@pytest.mark.parametrize("degree", [0, 3])
def test_the_page_shows_the_object_as_we_render_it(draw, degree, tmp_path):
    gaussians = snowman_and_pine(degree)
    path = write(gaussians, tmp_path)
    assert_equal(draw(path), ours(gaussians, VIEW), 40, path)


def test_an_object_upside_down_is_noticed(draw, tmp_path):
    gaussians = snowman_and_pine(0)
    path = write(turned(gaussians, "-y", "+y"), tmp_path)
    assert psnr(draw(path), ours(gaussians, VIEW)) < 15
