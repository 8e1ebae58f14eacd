"""The mesh of an asset opens in three.js upright, with the outline and the colours of our render."""

from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from programs.files import VIEW, keep
from programs.render_elsewhere import Browser, ours
from programs.snowman import snowman_and_pine
from scipy import ndimage

from cadam3d.exporter.mesh import MeshExporter
from cadam3d.rasterizer.cpu import CpuRasterizer

pytestmark = [pytest.mark.oracle, pytest.mark.slow]

SETTINGS = Path(__file__).parents[2] / "configs" / "exporter" / "mesh.yaml"
# The surface is about where a ray that grazes the object collects this alpha.
EDGE = 0.2


@pytest.fixture(scope="module")
def browser():
    with Browser.start() as started:
        yield started


@pytest.fixture(scope="module")
def seen():
    """Return our picture and its alpha."""
    gaussians = snowman_and_pine(0)
    with torch.no_grad():
        output = CpuRasterizer(cache_dir=None).render(gaussians, VIEW.cameras(), torch.ones(1, 3))
    return ours(gaussians, VIEW), output.alpha[0].numpy()


def write(folder: Path, **changes) -> Path:
    settings = yaml.safe_load(SETTINGS.read_text(encoding="utf-8"))
    del settings["_target_"]
    exporter = MeshExporter(**{**settings, "triangles": 20_000, **changes})

    def never(cameras, background):
        raise AssertionError("a mesh needs no picture")

    return exporter.export(snowman_and_pine(0), never, folder)[0]


def overlap(first: np.ndarray, second: np.ndarray) -> float:
    """Return the intersection of two masks over their union."""
    return float((first & second).sum() / (first | second).sum())


KINDS = {
    "glb": {},
    "obj": {"format": "obj"},
    "texture of obj": {"texture": 256, "format": "obj"},
}


@pytest.mark.parametrize("changes", list(KINDS.values()), ids=list(KINDS))
def test_the_mesh_has_the_outline_and_the_colours_of_our_render(browser, seen, changes, tmp_path):
    path = write(tmp_path, **changes)
    picture, (ours_, alpha) = browser.picture("mesh.html", path, VIEW), seen
    kept = keep(picture, ours_, path)
    outline = (picture < 250).any(axis=2)
    assert overlap(outline, alpha > EDGE) >= 0.95, kept
    difference = (picture.astype(float) - ours_)[outline & (alpha > 0.9)]
    assert np.abs(difference).mean() <= 10, kept  # of 255
    # Colours that were converted once too often or too seldom are all too bright or too dark.
    assert np.abs(difference.mean(axis=0)).max() <= 4, kept


def test_a_texture_shows_the_colours_of_the_vertices_without_specks(browser, tmp_path):
    plain = browser.picture("mesh.html", write(tmp_path, triangles=50_000), VIEW).astype(float)
    path = write(tmp_path, texture=512)
    textured = browser.picture("mesh.html", path, VIEW)
    kept = keep(textured, plain.astype(np.uint8), path)
    inside = ndimage.binary_erosion((plain < 250).any(axis=2) & (textured < 250).any(axis=2), iterations=3)
    # A speck differs from all pixels around it in the other picture, an edge that moved does not.
    low, high = (
        function(plain, size=(5, 5, 1)) for function in (ndimage.minimum_filter, ndimage.maximum_filter)
    )
    outside = np.maximum(low - textured, textured - high).clip(min=0).max(axis=2)[inside]
    assert np.abs(textured - plain)[inside].mean() <= 3, kept
    assert (outside > 40).mean() <= 2e-4, kept


def test_a_mesh_with_the_wrong_axes_is_noticed(browser, seen, tmp_path):
    path = write(tmp_path, up="-y")
    outline = (browser.picture("mesh.html", path, VIEW) < 250).any(axis=2)
    assert overlap(outline, seen[1] > EDGE) < 0.6
