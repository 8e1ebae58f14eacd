"""Checks, times and stages of the run on a GPU, with the emulator in place of the driver."""

import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))  # as Python does for a script

from emulation import load_emulator
from gpu_run import bisect, on_device
from mutants import MUTANTS, NUMBERS, plant
from rasterizer_bench.scenes import make_scene, make_shell
from rasterizer_bench.stages import REST, STAGES, TORCH, KernelRasterizer

CPU = torch.device("cpu")
PLANTED = "two sums are swapped"


def test_right_kernels_pass_the_self_test_and_every_stage_is_timed(emulator):
    assert not on_device.compare(KernelRasterizer(emulator), "cpu")["failed"]
    found = on_device.explain(emulator, CPU, ((30, 16, 2, 0),), 1)
    assert [row["stage"] for row in found["stages"]] == [*STAGES, TORCH, REST]
    sorts = on_device.compare_sorts(emulator, CPU, ((500, 32), (500, 9)), 1)["sorts"]
    assert all(min(row["ours_ms"], row["torch_ms"]) > 0 for row in sorts)


def test_a_wrong_kernel_fails_the_self_test_and_its_stage_is_named(build_cache, tmp_path, emulator):
    # For all degrees, because the self-test has degree 1.
    folder = plant({PLANTED: MUTANTS[PLANTED]}, tmp_path, only_degree_0=False)
    mutant = load_emulator(build_cache, folder, "-O0")
    mutant.activate(1)
    assert on_device.compare(KernelRasterizer(mutant), "cpu")["failed"]
    found = bisect.find_stage(mutant, CPU, emulator)
    assert found["stage"] == "blend backward"
    assert "records is wrong by" in found["says"]


PLANTED_STAGES = {
    "the last row of tiles is forgotten": "project",  # counts tiles with the same function as the lists
    "lists that disagree with their counts": "tile lists",
    "a list that misses its last splat": "tile sort",
    "a pixel that never closes": "blend forward",
    "two sums are swapped": "blend backward",
    "absolute values that cancel": "blend backward",
    "half of a long run": "project backward",
}


@pytest.mark.parametrize("name", PLANTED_STAGES)
def test_the_stage_of_a_planted_mistake_is_named(name, mutants, emulator, monkeypatch):
    plain = make_shell(60, 0, CPU)
    large = {"log_scales": plain.log_scales + 1.5, "opacity_logits": plain.opacity_logits + 4.0}
    wide = type(plain)(**plain.tensors() | large)
    monkeypatch.setattr(bisect, "scenes", lambda: [(make_scene(wide, 88, 1), 0.0)])
    mutants.activate(NUMBERS[name])
    try:
        found = bisect.find_stage(mutants, CPU, emulator)
    finally:
        mutants.activate(0)
    assert found["stage"] == PLANTED_STAGES[name], found
