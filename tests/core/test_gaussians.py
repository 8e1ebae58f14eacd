"""Gaussians: activations, and operations that keep the rows of all tensors together."""

import math

import pytest
import torch

from cadam3d.core.gaussians import FIELDS, Gaussians


def make(n: int, degree: int = 1, seed: int = 0) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)
    shapes = {
        "means": (3,),
        "log_scales": (3,),
        "quats": (4,),
        "opacity_logits": (),
        "sh": ((degree + 1) ** 2, 3),
    }
    return Gaussians(**{name: torch.randn(n, *shape, generator=generator) for name, shape in shapes.items()})


def assert_same(got: Gaussians, expected: Gaussians) -> None:
    for name in FIELDS:
        assert torch.equal(getattr(got, name), getattr(expected, name)), name


def test_activations_map_raw_numbers_to_physical_ones():
    gaussians = make(1)
    gaussians.log_scales[:] = torch.tensor([0.0, math.log(2), -1.0])
    gaussians.opacity_logits[:] = math.log(3)
    torch.testing.assert_close(gaussians.scales, torch.tensor([[1.0, 2.0, math.exp(-1)]]))
    torch.testing.assert_close(gaussians.opacities, torch.tensor([0.75]))


@pytest.mark.parametrize(
    ("axis", "turned"), [(1, [0.0, 0, 1]), (2, [0.0, 1, 0]), (3, [-1.0, 0, 0])], ids=["x", "y", "z"]
)
def test_quaternions_are_wxyz_and_turn_by_the_right_hand_rule(axis, turned):
    gaussians = make(1)
    gaussians.quats = torch.zeros(1, 4)
    gaussians.quats[0, 0] = gaussians.quats[0, axis] = 7.0  # a quarter turn; the length does not matter
    before = torch.tensor([0.0, 1, 0])
    torch.testing.assert_close(gaussians.rotations[0] @ before, torch.tensor(turned))


@pytest.mark.parametrize("length", [1e-30, 1e-7, 1e20, 1e38])
def test_quaternions_may_have_any_length(length):
    gaussians = make(20)
    expected = gaussians.rotations
    gaussians.quats = gaussians.quats * length
    torch.testing.assert_close(gaussians.rotations, expected)


def test_a_zero_quaternion_is_the_identity():
    gaussians = make(1)
    gaussians.quats = torch.zeros(1, 4)
    assert torch.equal(gaussians.rotations[0], torch.eye(3))


@pytest.mark.parametrize(
    "rows",
    [torch.tensor([3, 0, 3]), torch.tensor([True, False, True, True]), slice(1, 3)],
    ids=["int", "bool", "slice"],
)
def test_index_picks_the_same_rows_of_every_tensor(rows):
    gaussians = make(4)
    picked = gaussians.index(rows)
    for name in FIELDS:
        assert torch.equal(getattr(picked, name), getattr(gaussians, name)[rows])


def test_to_converts_every_tensor_and_map_does_not_touch_the_original():
    gaussians = make(3)
    assert all(tensor.dtype == torch.float64 for tensor in gaussians.to(torch.float64).tensors().values())
    gaussians.map(lambda tensor: tensor + 1)
    assert_same(gaussians, make(3))
    assert tuple(gaussians.tensors()) == FIELDS
