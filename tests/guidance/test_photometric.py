"""Laws of the photometric objective."""

import pytest
import torch

from cadam3d.core.errors import UserError
from cadam3d.guidance.photometric import Photometric
from cadam3d.prior.base import Condition
from cadam3d.prior.exact import ExactCondition
from cadam3d.prior.mixture import Mixture
from cadam3d.prior.objects.prior import MeshPrior
from cadam3d.prior.path import DDPM

PRIOR = MeshPrior(
    path="",
    folder=None,
    up="+y",
    noise_path=DDPM(),
    spread=0.1,
    edge_spread=0.1,
    model_error=0.0,
    samples_per_pixel=1,
    census_size=8,
    seed=0,
)
GUIDANCE = Photometric(weight=2.0, ssim_share=0.2)
GENERATOR = torch.Generator().manual_seed(0)
MODES = torch.rand(2, 3, 3, 16, 16, generator=GENERATOR, dtype=torch.float64)  # views, modes, channels


class Unknown(Condition):
    """Images that are not known."""

    def unprompted(self) -> "Unknown":
        return self


def condition() -> ExactCondition:
    mixture = Mixture(2 * MODES - 1, torch.zeros(3), torch.ones(2, 1, 3, 16, 16))
    return ExactCondition(mixture, mixture, mixture)


def image(mode: int) -> torch.Tensor:
    return MODES[:, mode].permute(0, 2, 3, 1).clone()


def loss_at(rgb: torch.Tensor, guidance: Photometric = GUIDANCE) -> torch.Tensor:
    return guidance(rgb, condition(), PRIOR, 0, torch.Generator()).loss


@pytest.mark.parametrize("mode", [0, 1, 2])
def test_the_loss_and_its_gradient_are_zero_at_the_truth(mode):
    rgb = image(mode).requires_grad_()
    loss = loss_at(rgb)
    loss.backward()
    assert float(loss.detach()) == pytest.approx(0, abs=1e-5)
    assert float(rgb.grad.abs().max()) < 1e-4


def test_descent_leads_to_the_nearest_mode():
    rgb = (image(1) + 0.1 * torch.randn(image(1).shape, generator=GENERATOR)).requires_grad_()
    optimizer = torch.optim.Adam([rgb], lr=0.01)
    for _ in range(60):
        optimizer.zero_grad()
        loss_at(rgb).backward()
        optimizer.step()
    distances = [float((rgb - image(mode)).abs().mean()) for mode in range(3)]
    assert distances[1] < 0.02
    assert min(distances[0], distances[2]) > 0.1


def test_without_ssim_the_loss_is_the_weighted_mean_difference():
    rgb = image(0) + 0.05
    plain = Photometric(weight=2.0, ssim_share=0.0)
    assert float(loss_at(rgb, plain)) == pytest.approx(0.1)


def test_a_prior_without_known_images_is_refused_in_one_line():
    with pytest.raises(
        UserError, match=r"^guidance: expected an objective .* got 'photometric'\. Try: guidance=sds"
    ):
        GUIDANCE(image(0), Unknown(), PRIOR, 0, torch.Generator())
