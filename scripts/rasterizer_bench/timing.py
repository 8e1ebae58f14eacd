"""Measure the time and the memory of the phases of a step."""

from typing import Any

import torch
from measuring import median, now
from rasterizer_bench.scenes import Scene

from cadam3d.rasterizer.base import Rasterizer

OUT_OF_MEMORY = (torch.OutOfMemoryError, MemoryError)


def take_turns(
    backends: dict[str, Rasterizer], scene: Scene, repeats: int
) -> dict[str, dict[str, Any] | None]:
    """Return the median times and the memory of every backend, and ``None`` for one that lacks memory.

    Backends take turns within each repetition, so other load on the machine affects all of them alike. The
    first round is not counted: it warms up and measures memory.
    """
    samples: dict[str, list[dict[str, Any]]] = {name: [] for name in backends}
    failed: set[str] = set()
    for _ in range(repeats + 1):
        for name in [each for each in backends if each not in failed]:
            try:
                is_first = not samples[name]
                measure = peak_memory if is_first else time_phases
                samples[name].append(measure(backends[name], scene))
            except OUT_OF_MEMORY:
                failed.add(name)
            scene.zero_grad()
    return {
        name: None if name in failed else samples[name][0] | median(samples[name][1:]) for name in backends
    }


def time_phases(rasterizer: Rasterizer, scene: Scene) -> dict[str, float]:
    """Return the milliseconds of each phase.

    ``step_ms`` is forward and backward as a training step calls them. ``host_ms`` is the part of it in which
    the host is busy, until it waits for the device.
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
    start_of_step = now(device)
    host = scene.step(rasterizer)
    step = now(device) - start_of_step
    times = {"step": step, "forward": middle - start, "backward": end - middle, "host": host}
    return {f"{phase}_ms": seconds * 1e3 for phase, seconds in times.items()}


def peak_memory(rasterizer: Rasterizer, scene: Scene) -> dict[str, int | None]:
    """Return the peak of bytes of forward and backward, including the gradients of the parameters.

    It covers both ways to render, because the second one reserves memory ahead. Torch counts its allocations
    on a CUDA device exactly. On a CPU the result would be unreliable and is ``None``.
    """
    device = scene.gaussians.device
    scene.zero_grad()
    before = 0
    if device.type == "cuda":
        torch.cuda.synchronize(device)
        before = torch.cuda.memory_allocated(device)
        torch.cuda.reset_peak_memory_stats(device)
    scene.backward(scene.render(rasterizer))
    scene.zero_grad()
    scene.step(rasterizer)
    if device.type != "cuda":
        return {"peak_bytes": None}
    torch.cuda.synchronize(device)
    return {"peak_bytes": torch.cuda.max_memory_allocated(device) - before}
