"""PreviewExporter: one sheet, a row for each elevation, a column for each azimuth."""

import imageio.v3 as imageio
import numpy as np
import torch

from cadam3d.core.gaussians import Gaussians
from cadam3d.core.rendering import RenderOutput
from cadam3d.exporter.preview import PreviewExporter

SETTINGS = {
    "views": 4,
    "elevations_deg": [0.0, 45.0, 90.0],
    "distance": 3.0,
    "fov_y_deg": 40.0,
    "size": 24,
    "background": [1.0, 0.0, 0.0],
    "labels": False,
}


def no_gaussians() -> Gaussians:
    return Gaussians(
        torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0), torch.zeros(0, 1, 3)
    )


def painted(cameras, background):
    """Return pictures with the background in red, the azimuth in green and the elevation in blue."""
    views, size = len(cameras), cameras.height
    colour = torch.stack(
        [background[:, 0], cameras.azimuth_deg % 360 / 360, cameras.elevation_deg / 90], dim=1
    )
    rgb = colour[:, None, None].expand(views, size, size, 3)
    empty = torch.zeros(views, 0)
    return RenderOutput(rgb, rgb[..., 0], rgb[..., 0], empty[..., None].expand(views, 0, 2), empty)


def test_rows_are_elevations_and_columns_azimuths(tmp_path):
    assert PreviewExporter(**SETTINGS).export(no_gaussians(), painted, tmp_path) == [tmp_path / "preview.png"]
    sheet = imageio.imread(tmp_path / "preview.png")
    assert sheet.shape == (72, 96, 3)
    cells = sheet.reshape(3, 24, 4, 24, 3)[:, 12, :, 12].astype(float) / 255
    assert (cells[..., 0] == 1).all()
    assert np.abs(cells[..., 1] - [[0, 0.25, 0.5, 0.75]] * 3).max() < 0.01
    assert np.abs(cells[..., 2].T - [[0, 0.5, 1]] * 4).max() < 0.01


def test_labels_are_written_on_request(tmp_path):
    PreviewExporter(**SETTINGS).export(no_gaussians(), painted, tmp_path)
    plain = imageio.imread(tmp_path / "preview.png")
    PreviewExporter(**{**SETTINGS, "labels": True}).export(no_gaussians(), painted, tmp_path)
    labelled = imageio.imread(tmp_path / "preview.png")
    changed = (plain != labelled).any(axis=-1).reshape(3, 24, 4, 24).any(axis=(1, 3))
    assert changed.all()
