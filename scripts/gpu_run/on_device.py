"""What the pieces of a run do on the GPU; each is started as ``python -m gpu_run.on_device NAME``.

A result is a JSON file. Its line ``says`` is what the report quotes.
"""

import argparse
import json
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

SCENES = ((20_000, 512, 1, 0), (100_000, 512, 4, 0), (1_000_000, 1024, 4, 0))
REPEATS = 10
# Keys and bits: pairs of 1M Gaussians in 4 views by depth, and their slots by tile at 1024 px.
SORTS = ((80_000, 32), (400_000, 32), (4_000_000, 32), (16_000_000, 17))


def facts() -> dict[str, Any]:
    """Return what torch says about the GPU; it fails if torch cannot use the GPU."""
    import torch

    from cadam3d.rasterizer.nvrtc import find_compiler

    # The first operation finds out whether torch has kernels for this GPU.
    assert (torch.ones(2, device="cuda") + 1).sum().item() == 4
    found = find_compiler()
    nvrtc = f"{'.'.join(map(str, found.version))} in {found.path}" if found else None
    memory = torch.cuda.get_device_properties(0).total_memory
    return {"torch": torch.__version__, "cuda": torch.version.cuda, "memory_bytes": memory, "nvrtc": nvrtc}


def self_test_cuda() -> dict[str, Any]:
    """Compare ``rasterizer=cuda`` with the reference on the GPU."""
    from cadam3d.rasterizer.cuda import CudaRasterizer

    return compare(CudaRasterizer(cache_dir=None), "cuda")


def compare(rasterizer: Any, device: str) -> dict[str, Any]:
    """Return the deviations of a rasterizer from the reference."""
    import torch

    from cadam3d.rasterizer.selftest import self_test

    begin = time.perf_counter()
    rasterizer.prepare(torch.device(device))
    compiling = time.perf_counter() - begin
    found = self_test(rasterizer, torch.device(device))
    return {
        "says": f"{found}; ready in {compiling:.1f} s",
        "failed": not found.passes,
        "images": dict(found.images),
        "gradients": dict(found.gradients),
        "repeats": found.repeats,
        "seconds_to_prepare": compiling,
    }


def gsplat() -> dict[str, Any]:
    """Compile or load gsplat, and compare it with the reference."""
    import torch
    from rasterizer_bench.check import check

    from cadam3d.rasterizer.gsplat import GsplatRasterizer
    from gpu_run.machine import require_nvcc

    require_nvcc(str(torch.version.cuda))
    device, begin = torch.device("cuda"), time.perf_counter()
    GsplatRasterizer().prepare(device)
    seconds = time.perf_counter() - begin
    troubles = check("gsplat", GsplatRasterizer(), device)
    verdict = "; ".join(troubles) or "agrees with the reference"
    return {"says": f"{verdict}; ready in {seconds:.0f} s", "failed": bool(troubles), "is_built": True}


def auto() -> dict[str, Any]:
    """Return the backend that ``rasterizer=auto`` uses on this GPU."""
    import torch

    from cadam3d.rasterizer.auto import choose

    backend = choose(torch.device("cuda")).backend
    reason = f": {backend.reason}" if backend.reason else ""
    return {"says": f"rasterizer=auto uses {backend.name}{reason}", "backend": backend.name}


def kernels() -> dict[str, Any]:
    """Time the kernels of some scenes, stage by stage, beside the wall clock."""
    import torch

    from cadam3d.rasterizer.cuda import load_kernels

    return explain(load_kernels(None), torch.device("cuda"), SCENES, REPEATS)


def explain(launcher: Any, device: Any, scenes: Any, repeats: int) -> dict[str, Any]:
    """Return the stages of the scenes."""
    from rasterizer_bench.scenes import make_scene, make_shell
    from rasterizer_bench.stages import time_stages

    rows, busy = [], []
    for count, size, views, degree in scenes:
        scene = make_scene(make_shell(count, degree, device), size, views)
        times = time_stages(launcher, scene, repeats)
        at = {"count": count, "size": size, "views": views, "degree": degree}
        rows += [at | stage for stage in times.stages]
        busy.append(f"{times.kernel_ms:.2f} of {times.wall_ms:.2f} ms")
    return {"says": f"kernels take {', '.join(busy)}", "stages": rows}


def sorts() -> dict[str, Any]:
    """Time our sort beside that of torch."""
    import torch

    from cadam3d.rasterizer.cuda import load_kernels

    return compare_sorts(load_kernels(None), torch.device("cuda"), SORTS, REPEATS)


def compare_sorts(launcher: Any, device: Any, sizes: Any, repeats: int) -> dict[str, Any]:
    """Return the times of both sorts, which take turns."""
    from functools import partial

    from measuring import in_turns, median, milliseconds
    from rasterizer_bench.check import make_keys, sort_keys

    found = []
    for count, bits in sizes:
        keys = make_keys(count, min(bits, 31), device)
        with launcher.on(device) as launch:
            works = {
                "ours": partial(milliseconds, partial(sort_keys, launch, keys, bits), device),
                "torch": partial(milliseconds, partial(keys.sort, stable=True), device),
            }
            ours, theirs = (median(times) for times in in_turns(works, repeats, warm_up=1).values())
        found.append({"keys": count, "bits": bits, "ours_ms": ours, "torch_ms": theirs})
    ratios = ", ".join(f"{each['torch_ms'] / each['ours_ms']:.2f}" for each in found)
    return {"says": f"our sort is this many times as fast as torch.sort: {ratios}", "sorts": found}


def stages() -> dict[str, Any]:
    """Return which stage of the kernels is the first that is wrong."""
    import torch

    from cadam3d.rasterizer.cuda import load_kernels
    from gpu_run.bisect import find_stage

    return find_stage(load_kernels(None), torch.device("cuda"))


WORK: dict[str, Callable[..., dict[str, Any]]] = {
    "facts": facts,
    "self-test": self_test_cuda,
    "gsplat": gsplat,
    "auto": auto,
    "kernels": kernels,
    "sorts": sorts,
    "stages": stages,
}


def main(words: list[str] | None = None) -> int:
    """Do one piece of work, write its result, and return the exit code: 1 if it shows a mistake."""
    parser = argparse.ArgumentParser("gpu_run.on_device", description=__doc__)
    parser.add_argument("name", choices=WORK)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args(words)
    try:
        result = WORK[args.name]()
    except Exception as error:
        # Whatever fails on an unknown machine becomes one line of the report; the log has the rest.
        traceback.print_exc()
        result = {"says": f"{type(error).__name__}: {error}".splitlines()[0], "failed": True}
    print(result.get("says", ""))
    if args.json:
        args.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return 1 if result.get("failed") else 0


if __name__ == "__main__":
    sys.exit(main())
