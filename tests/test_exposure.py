"""Laws of the exposure guard: when it dims colours, and how it measures brightness."""

import pytest
import torch

from cadam3d.core.errors import UserError
from cadam3d.core.rendering import RenderOutput
from cadam3d.exposure import BrightnessGuard, NoExposure

PUBLISHED = {"begin": 1000, "end": 4500, "quantile": 0.85, "threshold": 0.9, "rate": 0.8}


def guard(**changes) -> BrightnessGuard:
    return BrightnessGuard(**{**PUBLISHED, **changes})


def over(background: torch.Tensor, color: torch.Tensor, alpha: torch.Tensor) -> RenderOutput:
    """Composite ``color`` with coverage ``alpha`` over ``background``."""
    rgb = alpha[..., None] * color + (1 - alpha)[..., None] * background[:, None, None]
    views = len(alpha)
    return RenderOutput(
        rgb=rgb, alpha=alpha, depth=alpha, means2d=torch.zeros(views, 0, 2), radii=torch.zeros(views, 0)
    )


def scene(*levels: float) -> tuple[RenderOutput, torch.Tensor]:
    """Render one view with a grey object for each level, over white."""
    alpha = torch.zeros(len(levels), 8, 8)
    alpha[:, 2:6, 2:6] = 1.0
    white = torch.ones(len(levels), 3)
    return over(white, torch.tensor(levels)[:, None, None, None].expand(-1, 8, 8, 3), alpha), white


def factor(exposure: BrightnessGuard, output: RenderOutput, background: torch.Tensor, step: int) -> float:
    """Return the factor for all colours, which is 1 if nothing is dimmed."""
    found = exposure.dimming(output, background, step)
    return 1.0 if found is None else float(found)


def test_no_exposure_never_dims():
    output, background = scene(5.0, 5.0)
    assert all(NoExposure().dimming(output, background, step) is None for step in (1, 2000, 10**6))


@pytest.mark.parametrize(
    ("step", "dims"), [(1, False), (1000, False), (1001, True), (4499, True), (4500, False), (5000, False)]
)
def test_only_steps_strictly_between_begin_and_end_are_checked(step, dims):
    assert factor(guard(), *scene(1.0, 1.0), step) == pytest.approx(0.8 if dims else 1.0)


@pytest.mark.parametrize(("level", "dims"), [(0.0, False), (0.89, False), (0.91, True), (3.0, True)])
def test_colours_are_dimmed_above_the_threshold(level, dims):
    assert (factor(guard(), *scene(level, level), 2000) < 1) == dims


def test_dimming_depends_on_a_quantile_of_the_views():
    """The 0.85 quantile of four views is 0.45 times the third plus 0.55 times the fourth."""
    assert factor(guard(), *scene(0.0, 0.0, 0.8, 1.0), 2000) == pytest.approx(0.8)  # 0.91
    assert factor(guard(), *scene(0.0, 0.0, 0.7, 1.0), 2000) == 1  # 0.865


def test_brightness_is_a_quantile_of_the_pixels_without_the_background():
    alpha = torch.zeros(1, 10, 11)
    alpha[:, :, :10] = 1.0
    alpha[:, :, 10] = 0.0
    shades = torch.linspace(0, 1, 100).view(1, 10, 10)
    color = torch.cat([shades, torch.zeros(1, 10, 1)], dim=2)[..., None].expand(-1, -1, -1, 3)
    for backdrop in (torch.zeros(1, 3), torch.ones(1, 3), torch.tensor([[0.2, 0.9, 0.4]])):
        seen = guard().brightness(over(backdrop, color, alpha), backdrop)
        assert float(seen) == pytest.approx(0.85, abs=1e-5)


@pytest.mark.parametrize(("level", "backdrop"), [(0.2, 1.0), (0.95, 0.3)])
def test_a_coloured_background_does_not_decide(level, backdrop):
    """The published rule counts every pixel that is not black, so the background decides both cases."""
    alpha = torch.zeros(2, 8, 8)
    alpha[:, 3:5, 3:5] = 1.0
    color, behind = torch.full((2, 8, 8, 3), level), torch.full((2, 3), backdrop)
    output = over(behind, color, alpha)
    assert (factor(guard(), output, behind, 2000) < 1) == (level > 0.9)
    grey = output.rgb.mean(dim=-1)
    published = torch.stack([view[view > 0].quantile(0.85) for view in grey]).quantile(0.85)
    assert (published > 0.9) == (backdrop > 0.9)


def test_an_empty_view_is_dark():
    nothing = torch.zeros(2, 4, 4)
    white = torch.ones(2, 3)
    output = over(white, torch.ones(2, 4, 4, 3), nothing)
    assert guard().brightness(output, white).tolist() == [0.0, 0.0]
    assert factor(guard(), output, white, 2000) == 1


def test_the_guard_ends_after_it_begins():
    with pytest.raises(UserError, match=r"\.end: expected a step after begin"):
        guard(end=1000)
