"""Spherical harmonics: an orthonormal basis, in the order and with the signs of the 3DGS files."""

import math

import pytest
import torch
from torch import Tensor

from cadam3d.core.sh import evaluate_sh, rgb_to_sh0, sh_basis


def sphere(n: int = 40) -> tuple[Tensor, Tensor]:
    """Return directions and weights that integrate polynomials up to degree 40 over the sphere exactly."""
    nodes, weights = legendre(n)
    angle = torch.arange(2 * n, dtype=torch.float64) * (math.pi / n)
    z, phi = torch.meshgrid(nodes, angle, indexing="ij")
    r = (1 - z * z).sqrt()
    directions = torch.stack([r * phi.cos(), r * phi.sin(), z], dim=-1).reshape(-1, 3)
    return directions, (weights[:, None].expand_as(z) * (math.pi / n)).reshape(-1)


def legendre(n: int) -> tuple[Tensor, Tensor]:
    """Return Gauss-Legendre nodes and weights on [-1, 1] (Golub and Welsch 1969)."""
    k = torch.arange(1, n, dtype=torch.float64)
    beta = k / (4 * k * k - 1).sqrt()
    values, vectors = torch.linalg.eigh(torch.diag(beta, 1) + torch.diag(beta, -1))
    return values, 2 * vectors[0] ** 2


def test_the_basis_is_orthonormal_on_the_sphere():
    directions, weights = sphere()
    basis = sh_basis(directions, 3)
    gram = torch.einsum("n,ni,nj->ij", weights, basis, basis)
    torch.testing.assert_close(gram, torch.eye(16, dtype=torch.float64), atol=1e-12, rtol=0)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_degree_spans_the_same_functions_from_every_side(degree):
    # Each degree represents the rotations: rotating the argument mixes functions of that degree only.
    directions, weights = sphere()
    turn, _ = torch.linalg.qr(
        torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    )
    turn = turn * torch.linalg.det(turn)
    level = slice(degree**2, (degree + 1) ** 2)
    mixed = torch.einsum(
        "n,ni,nj->ij", weights, sh_basis(directions @ turn.T, 3)[:, level], sh_basis(directions, 3)
    )
    outside = torch.ones(16, dtype=torch.bool)
    outside[level] = False
    assert mixed[:, outside].abs().max() < 1e-12 if outside.any() else True
    block = mixed[:, level]
    torch.testing.assert_close(block @ block.T, torch.eye(2 * degree + 1, dtype=torch.float64))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_lower_degrees_are_a_prefix_of_higher_ones(degree):
    directions, _ = sphere(5)
    basis = sh_basis(directions, degree)
    assert basis.shape[-1] == (degree + 1) ** 2
    assert torch.equal(basis, sh_basis(directions, 3)[:, : basis.shape[-1]])


def test_signs_and_order_are_those_of_the_associated_legendre_functions():
    """Y_lm for m = -l..l, with the Condon-Shortley phase, from the textbook formula."""
    directions, _ = sphere(6)
    x, y, z = directions.unbind(-1)
    phi = torch.atan2(y, x)
    legendre_lm = {  # P_l^m(z) with the phase (-1)^m
        (0, 0): torch.ones_like(z),
        (1, 0): z,
        (1, 1): -(1 - z * z).sqrt(),
        (2, 0): (3 * z * z - 1) / 2,
        (2, 1): -3 * z * (1 - z * z).sqrt(),
        (2, 2): 3 * (1 - z * z),
        (3, 0): (5 * z**3 - 3 * z) / 2,
        (3, 1): -1.5 * (5 * z * z - 1) * (1 - z * z).sqrt(),
        (3, 2): 15 * z * (1 - z * z),
        (3, 3): -15 * (1 - z * z) ** 1.5,
    }
    columns = []
    for degree in range(4):
        for m in range(-degree, degree + 1):
            order = abs(m)
            norm = (
                (2 * degree + 1)
                / (4 * math.pi)
                * math.factorial(degree - order)
                / math.factorial(degree + order)
            )
            wave = torch.sin(order * phi) if m < 0 else torch.cos(order * phi)
            columns.append(
                (1 if m == 0 else math.sqrt(2)) * math.sqrt(norm) * legendre_lm[degree, order] * wave
            )
    torch.testing.assert_close(sh_basis(directions, 3), torch.stack(columns, dim=-1))


def test_colours_are_shifted_by_a_half_and_clamped_at_zero():
    directions, _ = sphere(3)
    sh = torch.zeros(len(directions), 4, 3, dtype=torch.float64)
    assert torch.equal(
        evaluate_sh(sh, directions), torch.full((len(directions), 3), 0.5, dtype=torch.float64)
    )
    sh[:, 0] = rgb_to_sh0(torch.tensor([-3.0, 0.25, 7.0], dtype=torch.float64))
    torch.testing.assert_close(
        evaluate_sh(sh, directions)[0], torch.tensor([0, 0.25, 7.0], dtype=torch.float64)
    )
