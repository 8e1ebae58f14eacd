"""Measure the time and the memory of the phases of a step."""

import statistics
from dataclasses import dataclass

import torch
from measuring import now
from rasterizer_bench.scenes import Scene

from cadam3d.rasterizer.base import Rasterizer

# ``step`` is forward and backward as a training step calls them. ``host`` is the part of it in which the host
# is busy, until it waits for the device.
PHASES = ("forward", "backward", "forward_backward", "step", "host")
OUT_OF_MEMORY = (torch.OutOfMemoryError, MemoryError)


@dataclass(frozen=True)
class Timing:
    """The times of one backend on one scene, over all repetitions."""

    median_ms: dict[str, float]  # by phase
    peak_bytes: int | None  # without the scene itself; None if it cannot be measured


def take_turns(backends: dict[str, Rasterizer], scene: Scene, repeats: int) -> dict[str, Timing | None]:
    """Return the timing of every backend, and ``None`` for those that ran out of memory.

    Backends take turns within each repetition, so other load on the machine affects all of them alike. The
    first round is not counted: it warms up and measures memory.
    """
    samples: dict[str, list[dict[str, float]]] = {name: [] for name in backends}
    peaks: dict[str, int | None] = {}
    failed: set[str] = set()
    for repeat in range(repeats + 1):
        for name, rasterizer in backends.items():
            if name in failed:
                continue
            try:
                if repeat == 0:
                    peaks[name] = peak_memory(rasterizer, scene)
                else:
                    samples[name].append(time_phases(rasterizer, scene))
            except OUT_OF_MEMORY:
                failed.add(name)
            scene.zero_grad()
    return {name: None if name in failed else summarize(samples[name], peaks[name]) for name in backends}


def summarize(samples: list[dict[str, float]], peak: int | None) -> Timing:
    """Return the median time of each phase, with the peak of memory."""
    return Timing({phase: statistics.median(each[phase] for each in samples) for phase in PHASES}, peak)


def time_phases(rasterizer: Rasterizer, scene: Scene) -> dict[str, float]:
    """Return the milliseconds of each phase.

    Forward and backward together are timed separately, without waiting for the device between them, and once
    more as a training step calls them.
    """
    device = scene.gaussians.device
    scene.zero_grad()
    start = now(device)
    images = scene.render(rasterizer)
    middle = now(device)
    scene.backward(images)
    end = now(device)
    del images
    scene.zero_grad()
    again = now(device)
    scene.backward(scene.render(rasterizer))
    whole = now(device) - again
    scene.zero_grad()
    start_of_step = now(device)
    host = scene.step(rasterizer)
    step = now(device) - start_of_step
    return {
        "forward": (middle - start) * 1e3,
        "backward": (end - middle) * 1e3,
        "forward_backward": whole * 1e3,
        "step": step * 1e3,
        "host": host * 1e3,
    }


def peak_memory(rasterizer: Rasterizer, scene: Scene) -> int | None:
    """Return the peak of bytes of forward and backward, including the gradients of the parameters.

    It covers both ways to render, because the second one reserves memory ahead.

    Torch counts its allocations on a CUDA device exactly. On a CPU the system counts pages, and the allocator
    keeps freed memory, so the result would be unreliable and is ``None``.
    """
    device = scene.gaussians.device
    scene.zero_grad()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
        before = torch.cuda.memory_allocated(device)
        torch.cuda.reset_peak_memory_stats(device)
    scene.backward(scene.render(rasterizer))
    scene.zero_grad()
    scene.step(rasterizer)
    if device.type != "cuda":
        return None
    torch.cuda.synchronize(device)
    return torch.cuda.max_memory_allocated(device) - before
