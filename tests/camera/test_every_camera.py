"""Laws of every camera sampler: draws depend on the generator alone, and angles agree with positions."""

from dataclasses import replace

import pytest
import torch
from composed import composed

from cadam3d.build import component
from cadam3d.core.cameras import around

NAMES = ("orbit", "multiview", "sphere", "progressive")
STILL = {"position_jitter": 0.0, "target_jitter": 0.0, "up_jitter": 0.0}


@pytest.fixture(params=NAMES)
def sampler(request):
    return component(composed("prompt=a red cube", f"camera={request.param}").camera, key="camera")


@pytest.mark.parametrize("step", [0, 700])
def test_a_sample_is_a_function_of_step_and_generator(sampler, step):
    first, again, other = (
        sampler.sample(step, 4, torch.Generator().manual_seed(seed)).world_to_camera for seed in (1, 1, 2)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_later_draws_do_not_depend_on_the_step(sampler):
    states = []
    for step in (0, 600, 5000):
        generator = torch.Generator().manual_seed(0)
        sampler.sample(step, 4, generator)
        states.append(generator.get_state())
    assert torch.equal(states[0], states[1])
    assert torch.equal(states[0], states[2])


def test_the_recorded_angles_are_those_of_the_positions(sampler):
    still = replace(sampler, **STILL) if hasattr(sampler, "up_jitter") else sampler
    cameras = still.sample(0, 48, torch.Generator().manual_seed(0))
    outward, _ = around(cameras.azimuth_deg, cameras.elevation_deg)
    position = cameras.positions
    torch.testing.assert_close(position / position.norm(dim=-1, keepdim=True), outward, atol=1e-4, rtol=0)
