"""Rotation matrices: kornia's to the last bit, values and gradients."""

import jaxtyping
import pytest
import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix

from cadam3d.core.rotation import rotation_matrices


@pytest.mark.oracle
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_matrices_and_gradients_equal_those_of_kornia_to_the_last_bit(dtype):
    generator = torch.Generator().manual_seed(0)
    quats = (
        torch.randn(300, 4, generator=generator, dtype=dtype)
        * torch.logspace(-3, 3, 300, dtype=dtype)[:, None]
    )
    quats[0] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    quats[1] = 0.0
    weights = torch.randn(300, 3, 3, generator=generator, dtype=dtype)
    found = []
    for convert in (rotation_matrices, quaternion_to_rotation_matrix):
        leaf = quats.clone().requires_grad_()
        matrices = convert(leaf)
        (matrices * weights).sum().backward()
        found.append((matrices.detach(), leaf.grad))
    for ours, theirs in zip(*found, strict=True):
        assert torch.equal(ours, theirs)


def test_the_suite_checks_the_shapes_that_functions_state():
    with pytest.raises(jaxtyping.TypeCheckError):
        rotation_matrices(torch.zeros(4))
