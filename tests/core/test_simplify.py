"""Laws of simplification: the number asked for, preserved moments, and what each method keeps."""

import math
from dataclasses import replace

import pytest
import torch
from splats import make_gaussians

from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import FIELDS, Gaussians, concatenate
from cadam3d.core.simplify import METHODS, Simplify, shadows, simplification
from cadam3d.rasterizer.reference import ReferenceRasterizer

RENDER = ReferenceRasterizer().render


def simplified(gaussians: Gaussians, count: int, method: str = "merge") -> Gaussians:
    return simplification(gaussians, count, method, RENDER).apply(gaussians)


def moments(gaussians: Gaussians) -> tuple[torch.Tensor, ...]:
    """Return weight, mean, covariance and mean SH of all Gaussians as one mixture, with plain matrices."""
    g = gaussians.to(torch.float64)
    weights = g.opacities * shadows(g.scales)
    share = weights / weights.sum()
    mean = (share[:, None] * g.means).sum(0)
    each = g.rotations @ torch.diag_embed(g.scales**2) @ g.rotations.mT
    apart = g.means - mean
    covariance = (share[:, None, None] * (each + apart[:, :, None] * apart[:, None, :])).sum(0)
    return weights.sum(), mean, covariance, (share[:, None, None] * g.sh).sum(0)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("count", [1, 7, 30])
def test_each_method_leaves_the_number_asked_for_and_changes_nothing(method, count):
    scene = make_gaussians(60, degree=1)
    before = scene.map(torch.clone)
    found = [simplified(scene, count, method) for _ in range(2)]
    assert len(found[0]) == count
    for name in FIELDS:
        assert torch.equal(getattr(found[0], name), getattr(found[1], name))
        assert torch.equal(getattr(scene, name), getattr(before, name))
        assert getattr(found[0], name).isfinite().all()


def test_one_gaussian_has_the_moments_of_all_that_it_replaces():
    scene = make_gaussians(40, degree=2, opacity=-4.0)
    for got, want in zip(moments(simplified(scene, 1)), moments(scene), strict=True):
        torch.testing.assert_close(got, want, rtol=1e-5, atol=1e-6)


def test_merging_keeps_the_moments_of_the_whole_at_every_count():
    scene = make_gaussians(80, opacity=-5.0)
    for count in (5, 20, 50):
        for got, want in zip(moments(simplified(scene, count)), moments(scene), strict=True):
            torch.testing.assert_close(got, want, rtol=1e-4, atol=1e-5)


def test_a_merged_gaussian_is_never_more_opaque_than_its_parts_behind_each_other():
    one = replace(make_gaussians(1), opacity_logits=torch.tensor([0.6]).logit())
    [opacity] = simplified(concatenate([one] * 3), 1).opacities.tolist()
    assert opacity == pytest.approx(1 - 0.4**3, rel=1e-5)


def test_near_gaussians_of_one_colour_merge_first_and_the_others_stay_bit_for_bit():
    scene = make_gaussians(4, log_scale=-3.0, opacity=0.0)
    scene = replace(scene, means=torch.tensor([[0.0, 0, 0], [0.01, 0, 0], [0.02, 0, 0], [1.0, 0, 0]]))
    scene = replace(scene, log_scales=torch.full((4, 3), -3.0), sh=torch.zeros(4, 1, 3))
    scene.sh[0] = 2.0
    edit = simplification(scene, 3, "merge")
    assert edit.keep.tolist() == [0, 3]
    assert edit.parents.tolist() == [int(scene.opacity_logits[1:3].argmax()) + 1]
    assert edit.children.means[0, 0] == pytest.approx(0.015, abs=0.005)


def test_shadows_are_the_mean_area_over_all_directions():
    scales = torch.tensor([[1.0, 1.0, 1.0], [1.0, 0.5, 0.1], [1.0, 1.0, 1e-6], [1.0, 1e-3, 1e-3]]).double()
    direction = torch.randn(100_000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    direction /= direction.norm(dim=1, keepdim=True)
    # The shadow along a direction d has the area pi |S| |S^-1 d|.
    areas = math.pi * scales.prod(1) * (direction[:, None] / scales).norm(dim=-1).mean(0)
    torch.testing.assert_close(shadows(scales), areas, rtol=0.015, atol=0)


def test_the_most_opaque_stay_in_their_order():
    scene = make_gaussians(50)
    kept = simplification(scene, 10, "opacity").keep
    assert set(kept.tolist()) == set(scene.opacity_logits.topk(10).indices.tolist())
    assert kept.tolist() == sorted(kept.tolist())


def test_contribution_drops_a_gaussian_that_others_hide():
    shell = torch.nn.functional.normalize(make_gaussians(300).means, dim=1) * 0.5
    scene = replace(make_gaussians(301), means=torch.cat([torch.zeros(1, 3), shell]))
    scene = replace(scene, log_scales=torch.full((301, 3), -2.0), opacity_logits=torch.full((301,), 6.0))
    assert 0 not in simplification(scene, 290, "contribution", RENDER).keep


def test_rows_that_are_not_finite_go_first():
    scene = make_gaussians(20)
    scene.means[3], scene.opacity_logits[5], scene.log_scales[8] = math.nan, math.nan, 1e3
    found = simplified(scene, 18)
    assert len(found) == 17
    assert all(tensor.isfinite().all() for tensor in found.tensors().values())


@pytest.mark.parametrize(
    ("settings", "size"), [((None, None), 10), ((4, None), 4), ((40, None), 10), ((None, 0.25), 3)]
)
def test_the_size_follows_count_or_fraction(settings, size):
    how = Simplify(count=settings[0], fraction=settings[1], simplify="merge")
    assert how.size(10) == size
    scene = make_gaussians(10)
    assert (how.simplified(scene, RENDER) is scene) == (size == 10)


def test_count_beside_fraction_is_refused():
    with pytest.raises(UserError) as caught:
        Simplify(count=4, fraction=0.1, simplify="merge")
    assert (
        str(caught.value)
        == "Simplify.fraction: expected null with count=4, got 0.1. Try: Simplify.fraction=null"
    )
