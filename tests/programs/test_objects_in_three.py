"""Our images of textured meshes equal those of three.js, an independent renderer."""

import base64
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from urllib.parse import urlencode

import numpy as np
import pytest
import torch
from PIL import Image
from programs.render_elsewhere import PATIENCE_S, Browser, View
from scipy import ndimage

from cadam3d.prior.objects import scene
from cadam3d.prior.objects.catalog import WORLD, read_catalog

pytestmark = [pytest.mark.oracle, pytest.mark.slow]

VIEWS = [
    View(azimuth_deg, elevation_deg, size=256)
    for azimuth_deg, elevation_deg in ((25.0, 15.0), (120.0, -20.0), (215.0, 60.0), (305.0, 5.0))
]
CENSUS = read_catalog(None).census  # which no picture needs
SAMPLES = 4  # per pixel along each axis
FLAT = 4 / 255  # the largest range within 5 x 5 pixels of a flat region


@pytest.fixture(scope="module")
def browser():
    with Browser.start() as started:
        yield started


def theirs(browser: Browser, path: Path) -> np.ndarray:
    """Return what three.js draws of a file from each view: premultiplied RGBA in [0, 1]."""
    browser.folders["files"] = path.parent
    settings = {
        "file": f"/files/{path.name}",
        "eye": "0,0,1",
        "eyes": ";".join(",".join(map(str, view.eye)) for view in VIEWS),
        "fov": VIEWS[0].fov_y_deg,
        "size": VIEWS[0].size * SAMPLES,
        "radius": scene.FIT_RADIUS,
    }
    address = f"{browser.origin}/pages/unlit.html?{urlencode(settings)}"
    with browser.open(address, 256, 256) as page:
        page.wait_for_function("window.result !== undefined", timeout=1000 * PATIENCE_S)
        assert page.evaluate("window.result") == "drawn"
        urls = page.evaluate("window.pictures")
    files = (BytesIO(base64.b64decode(url.split(",")[1])) for url in urls)
    fine = np.stack([np.asarray(Image.open(file)) for file in files]) / 255
    fine[..., :3] *= fine[..., 3:]
    size = VIEWS[0].size
    return fine.reshape(len(VIEWS), size, SAMPLES, size, SAMPLES, 4).mean(axis=(2, 4))


def ours(path: Path) -> np.ndarray:
    """Return what we draw of a file without light, also with textures at full size only."""
    mesh = scene.read_object(str(path), "prior.path", "+y")
    mesh = replace(mesh, textures=replace(mesh.textures, levels=mesh.textures.levels[:, :1]))
    drawn = []
    for view in VIEWS:
        rgb, alpha = scene.MeshScene([mesh], CENSUS).draw(view.cameras(), torch.zeros(1, 3), SAMPLES)
        drawn.append(torch.cat([rgb[0, 0], alpha[0]]).permute(1, 2, 0))
    return torch.stack(drawn).numpy()


def around(images: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the largest values within ``size`` x ``size`` pixels."""
    window = (1, size, size, 1)
    return ndimage.minimum_filter(images, window), ndimage.maximum_filter(images, window)


def assert_equal(first: np.ndarray, second: np.ndarray, mean: float) -> None:
    """Check colours in flat regions and elsewhere, and outlines to a pixel and two samples."""
    difference = 255 * np.abs(first - second).max(axis=3)
    flat = np.ones(difference.shape, dtype=bool)
    for one, other in ((first, second), (second, first)):
        low, high = around(one, 5)
        flat &= (high - low).max(axis=3) <= FLAT
        low, high = around(one[..., 3:], 3)
        alpha = other[..., 3:]
        assert np.maximum(low - alpha, alpha - high).max() <= 2 / SAMPLES**2
    covered = (first[..., 3] > 0) | (second[..., 3] > 0)
    assert difference[flat].max() <= 1
    assert difference[covered & ~flat].mean() <= mean


# Holes have more edges, where the difference is one sample.
OBJECTS = {"teddy_bear": 0.2, "milk_carton": 0.3, "deck_chair": 0.4, "cane_chair": 1.0}


@pytest.mark.parametrize(("name", "mean"), OBJECTS.items(), ids=OBJECTS)
def test_an_object_looks_as_in_three(browser, name, mean, monkeypatch):
    monkeypatch.setattr(scene, "light_on", lambda normal: torch.ones_like(normal[0]))
    path = WORLD / f"{name}.glb"
    assert_equal(ours(path), theirs(browser, path), mean)
