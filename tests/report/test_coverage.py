"""Simulated sweeps: intervals cover the truth, planted differences are found, and planted nulls are not.

The tables of docs/notes/sweep_statistics.md are printed by

    SIMULATIONS=5000 python -m pytest -s -n 0 tests/report/test_coverage.py
"""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cadam3d.core.number import COUNT, Number
from cadam3d.report.compare import every_pair
from cadam3d.report.estimate import Estimate, holm
from cadam3d.report.results import ArmSetting, Cell, JobResult

SIMULATIONS = int(os.environ.get("SIMULATIONS", "0"))
# Differences of prompts: with ordinary, heavy and very uneven tails.
Draw = Callable[[np.random.Generator, tuple[int, ...]], np.ndarray]
DRAWS: dict[str, Draw] = {
    "normal": lambda rng, shape: rng.standard_normal(shape),
    "Student's t, 2 degrees": lambda rng, shape: rng.standard_t(2, shape),
    "exponential": lambda rng, shape: rng.standard_exponential(shape),
    "log-normal": lambda rng, shape: np.exp(rng.standard_normal(shape)),
}
PSNR = Number(name="psnr", label="PSNR", unit="dB", digits=2, is_more_better=True, preference=10)


def cell(prompt: int, seed: int = 0) -> Cell:
    return Cell((("prompt", f"object {prompt}"), ("seed", str(seed))))


def differences(draw: Draw, rng: np.random.Generator, prompts: int, cells: int) -> np.ndarray:
    """Return differences of shape (prompts, cells), in which seeds vary half as much as prompts."""
    own = draw(rng, (prompts, 1))
    return own + 0.5 * draw(rng, (prompts, cells)) if cells > 1 else own


def truth_of(draw: Draw, cells: int) -> float:
    """Return the median of the mean of two random prompts."""
    prompts = np.median(differences(draw, np.random.default_rng(1), 400_000, cells), axis=1)
    return float(np.median(prompts.reshape(2, -1).mean(axis=0)))


def coverage(draw: Draw, prompts: int, cells: int, simulations: int) -> float:
    """Return the share of simulated sweeps in % whose interval contains the truth."""
    truth, rng = truth_of(draw, cells), np.random.default_rng(0)
    names = [cell(prompt, seed) for prompt in range(prompts) for seed in range(cells)]
    hits = 0
    for _ in range(simulations):
        values = differences(draw, rng, prompts, cells)
        found = Estimate.of(dict(zip(names, values.ravel().tolist(), strict=True)))
        assert found.low is not None
        assert found.high is not None
        hits += found.low <= truth <= found.high
    return 100 * hits / simulations


@pytest.mark.parametrize(
    ("prompts", "cells"), [(6, 1), (6, 3), (12, 1), (12, 3)] if SIMULATIONS else [(6, 3), (12, 1)]
)
@pytest.mark.parametrize("name", DRAWS)
def test_an_interval_contains_the_truth_in_92_to_98_percent_of_sweeps(name, prompts, cells):
    found = coverage(DRAWS[name], prompts, cells, SIMULATIONS or 1000)
    if SIMULATIONS:
        print(f"\n| {name} | {prompts} | {cells} | {found:.1f} |")
    assert 92 <= found <= 98


def job(arm: int, prompt: int, psnr: float) -> JobResult:
    return JobResult(
        arm=f"arm {arm}",
        name="",
        overrides=[],
        swept={},
        number=0,
        folder=Path(),
        summary={"outcome": "finished"},
        setting=ArmSetting(f"arm {arm}"),
        is_standard=True,
        cell=cell(prompt),
        numbers={"num_gaussians": 1.0, "psnr": psnr},
        declared={"num_gaussians": COUNT, "psnr": PSNR},
        scores={},
    )


def found_pairs(psnr: np.ndarray) -> list[set[tuple[str, str]]]:
    """Return the pairs of arms that the report finds, and those that sign tests would find.

    ``psnr`` has the shape (prompts, arms).
    """
    pairs = every_pair([job(arm, prompt, value) for (prompt, arm), value in np.ndenumerate(psnr)])
    names = [(pair.comparison.ours.arm, pair.comparison.theirs.arm) for pair in pairs]
    signs = holm([pair.difference.sign_p_value for pair in pairs])
    certain = [[pair.is_certain for pair in pairs], [p_value <= 0.05 for p_value in signs]]
    return [{name for name, is_found in zip(names, each, strict=True) if is_found} for each in certain]


def errors_and_power(draw: Draw, arms: int, prompts: int, better: float, simulations: int) -> np.ndarray:
    """Return how often the report errs and finds, in %: a line for its test and one for the sign test.

    The last arm is better by ``better``, and the others are equal. The first column is the share of sweeps
    in which equal arms are found to differ, and the second is the share of the other pairs that is found. The
    first arm varies a third as much as the others, so that its differences are as uneven as they are.
    """
    rng = np.random.default_rng(0)
    sample = 0.3 * rng.standard_normal(400_000) + draw(rng, (400_000,))
    middle = float(np.median(sample.reshape(2, -1).mean(axis=0)))
    different = {(f"arm {arms - 1}", f"arm {arm}") for arm in range(arms - 1)} if better else set()
    found = np.zeros((2, 2))
    for _ in range(simulations):
        psnr = -draw(rng, (prompts, arms))
        psnr[:, 0] = 0.3 * rng.standard_normal(prompts) - middle
        psnr[:, -1] += better
        for line, pairs in zip(found, found_pairs(psnr), strict=True):
            line += [bool(pairs - different), len(pairs & different) / (arms - 1)]
    return 100 * found / simulations


@pytest.mark.parametrize("better", [0, 2] if SIMULATIONS else [2])
@pytest.mark.parametrize(("arms", "prompts"), [(2, 6), (4, 12), (8, 12)] if SIMULATIONS else [(4, 12)])
@pytest.mark.parametrize("name", DRAWS if SIMULATIONS else ["normal", "log-normal"])
def test_planted_differences_are_found_and_planted_nulls_are_not(name, arms, prompts, better):
    found = errors_and_power(DRAWS[name], arms, prompts, better, SIMULATIONS // 2 or 60)
    if SIMULATIONS:
        numbers = " | ".join(f"{error:.1f} | {power:.0f}" for error, power in found)
        print(f"\n| {name} | {arms} | {prompts} | {better} | {numbers} |")
    assert found[0, 0] <= 6
    assert found[0, 1] > 40 * (better > 0 and arms == 4)
