"""Images show the numbers that they are made from."""

import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from cadam3d.io.image import closeness, colorize, contact_sheet, cutout, to_uint8, write_png


def test_bytes_are_rounded_and_clamped():
    values = torch.tensor([-1.0, 0.0, 0.5, 0.9999, 1.0, 7.0]).reshape(1, 2, 3)
    assert to_uint8(values).flatten().tolist() == [0, 0, 128, 255, 255, 255]


def test_nan_is_black():
    assert to_uint8(torch.full((1, 1, 3), float("nan"))).max() == 0


def test_a_png_preserves_every_byte(tmp_path):
    pixels = torch.arange(256 * 3).reshape(16, 16, 3).remainder(256)
    write_png(tmp_path / "a.png", pixels / 255)
    assert np.array_equal(imageio.imread(tmp_path / "a.png"), pixels.numpy())


def test_the_colour_map_gets_brighter_from_end_to_end():
    luminance = colorize(torch.linspace(0, 1, 200)[None])[0] @ torch.tensor([0.2126, 0.7152, 0.0722])
    assert (luminance.diff() > 0).all()


def test_near_is_bright_and_background_is_black():
    depth = torch.tensor([[2.1, 3.0, 3.9, 0.0]])
    picture = closeness(depth, torch.tensor([[1.0, 1.0, 1.0, 0.0]]), distance=3.0)[0].sum(dim=-1)
    assert picture[0] > picture[1] > picture[2] > picture[3] == 0


def test_a_contact_sheet_has_its_images_in_reading_order():
    images = torch.rand(5, 4, 6, 3)
    sheet = contact_sheet(images, columns=3)
    assert sheet.shape == (8, 18, 3)
    for i, image in enumerate(images):
        row, column = divmod(i, 3)
        assert torch.equal(sheet[4 * row : 4 * row + 4, 6 * column : 6 * column + 6], image)
    assert (sheet[4:, 12:] == 1).all()


@pytest.mark.parametrize("shade", [0.0, 1.0])
def test_labels_are_legible_on_dark_and_light_and_stay_in_the_corner(shade):
    images = torch.full((2, 64, 64, 3), shade)
    sheet = contact_sheet(images, columns=2, labels=["90, 15"])
    changed = (sheet != shade).any(dim=-1)
    assert (sheet[:, :64] - shade).abs().max() > 0.6
    assert not changed[20:].any()
    assert not changed[:, 64:].any()
    assert (images == shade).all()


def test_a_transparent_picture_over_any_colour_is_the_render_over_that_colour(tmp_path):
    draw = torch.Generator().manual_seed(0)
    alpha = torch.rand(32, 32, generator=draw) ** 4
    alpha[:4], alpha[-4:] = 0.0, 0.9999
    over_black = torch.rand(32, 32, 3, generator=draw) * alpha[..., None]
    write_png(tmp_path / "a.png", cutout(over_black, alpha))
    pixels = torch.from_numpy(imageio.imread(tmp_path / "a.png")) / 255
    assert pixels.shape == (32, 32, 4)
    for shade in (0.0, 0.3, 1.0):
        composited = pixels[..., :3] * pixels[..., 3:] + (1 - pixels[..., 3:]) * shade
        rendered = over_black + (1 - alpha[..., None]) * shade
        assert (composited - rendered).abs().max() <= 1.001 / 255
