"""Gradients and gradient histories for the tests of densifiers."""

import torch

from cadam3d.core.edit import RowEdit
from cadam3d.core.gaussians import Gaussians
from cadam3d.densifier.base import GradientSignal
from cadam3d.densifier.cadam import CAdam, CAdamState
from cadam3d.densifier.cadam_open import CAdamOpen
from cadam3d.optimizer import AdamSettings

CPU = torch.device("cpu")
STEP = 100  # of a refinement; only schedules depend on it
DRAWS = torch.Generator()  # CAdam never draws from it
PAPER = {
    "tau_Q": 0.9,
    "tau_SNR": 0.1,
    "beta1": 0.9,
    "beta2": 0.999,
    "eps": 1e-15,
    "min_age": 0,
    "reset": "unreliable",
    "reset_min_age": 0,
}
OPEN = {
    "grad_norm": "none",
    "invisible": "zero",
    "tau_m": None,
    "alpha": None,
    "tau_reset": None,
}


def cadam(**changes) -> CAdam:
    """Return the paper's densifier with ``changes``, and without minimum ages."""
    return CAdam(**{**PAPER, **changes})


def open_cadam(**changes) -> CAdamOpen:
    """Return the same densifier with its open choices as settings."""
    return CAdamOpen(**{**PAPER, **OPEN, **changes})


def signal(means: torch.Tensor, visible: torch.Tensor | None = None) -> GradientSignal:
    n = len(means)
    visible = torch.ones(1, n, dtype=torch.bool) if visible is None else visible
    return GradientSignal(
        means=means, means2d=torch.zeros(len(visible), n, 2), radii=visible.float(), height=8, width=8
    )


def signal_without_values() -> GradientSignal:
    """Return a signal of 4 Gaussians whose tensors have shapes only, so that reading a value is an error."""
    meta = torch.device("meta")
    return GradientSignal(
        means=torch.empty(4, 3, device=meta),
        means2d=torch.empty(2, 4, 2, device=meta),
        radii=torch.empty(2, 4, device=meta),
        height=8,
        width=8,
    )


def observe(densifier: CAdam, gradients: torch.Tensor) -> CAdamState:
    """Return the state after all ``gradients`` ("t n 3"), from birth."""
    state = densifier.init_state(gradients.shape[1], CPU)
    for step in gradients:
        state = densifier.observe(state, signal(step))
    return state


def noise(steps: int, n: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(steps, n, 3, generator=torch.Generator().manual_seed(seed))


def snr(densifier: CAdam, state: CAdamState) -> torch.Tensor:
    drift, strength = densifier.strengths(state)
    return drift / strength


def some_gaussians(n: int) -> Gaussians:
    return Gaussians(
        means=noise(1, n)[0],
        log_scales=torch.full((n, 3), -4.0),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        opacity_logits=torch.linspace(-2.0, 2.0, n),
        sh=torch.zeros(n, 1, 3),
    )


def adam() -> AdamSettings:
    rates = ("means_lr", "sh_dc_lr", "sh_rest_lr", "opacity_lr", "scale_lr", "quat_lr")
    constants = {"beta1": 0.9, "beta2": 0.999, "eps": 1e-15, "clip_norm": None, "clip_unit": 1.0}
    return AdamSettings(**dict.fromkeys(rates, 0.01), **constants)


def edit_of(n: int, keep: list[int], parents: list[int]) -> RowEdit:
    return RowEdit(
        keep=rows_of(keep),
        children=some_gaussians(n).index(rows_of(parents)),
        parents=rows_of(parents),
    )


def rows_of(rows: list[int]) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.int64)
