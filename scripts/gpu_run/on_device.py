"""What the pieces of a run do on the GPU; each is started as ``python -m gpu_run.on_device NAME``.

A result is a JSON file. Its line ``says`` is what the report quotes.
"""

import argparse
import csv
import io
import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

SCENES = ((20_000, 512, 1, 0), (100_000, 512, 4, 0), (1_000_000, 1024, 4, 0))
REPEATS = 10
# Keys and bits: pairs of 1M Gaussians in 4 views by depth, and their slots by tile at 1024 px.
SORTS = ((80_000, 32), (400_000, 32), (4_000_000, 32), (16_000_000, 17))
COPY_BYTES = 2**30
COUNTED = "regex:blend_|sort_|project_|tile_"
# Enough kernels for one forward and backward pass.
COUNTED_KERNELS = 40
SECTIONS = ("SpeedOfLight", "Occupancy", "LaunchStats", "WarpStateStats")
METRICS = (
    "Duration",
    "Compute (SM) Throughput",
    "Memory Throughput",
    "Achieved Occupancy",
    "Registers Per Thread",
    "Warp Cycles Per Issued Instruction",
)


def facts() -> dict[str, Any]:
    """Return what torch says about the GPU, or a line about what keeps torch from using it."""
    import torch

    found: dict[str, Any] = {"torch": torch.__version__, "torch_cuda": torch.version.cuda}
    if torch.version.cuda is None:
        return found | {"trouble": f"torch {torch.__version__} is built without CUDA. {_other_torch()}"}
    try:
        # The first operation finds out whether torch has kernels for this GPU.
        assert (torch.ones(2, device="cuda") + 1).sum().item() == 4
    except (RuntimeError, AssertionError) as error:
        reason = (str(error).strip().splitlines() or ["an addition is wrong"])[0]
        return found | {
            "trouble": f"torch {torch.__version__} (CUDA {torch.version.cuda}) cannot use this GPU: "
            f"{reason.rstrip('.')}. {_other_torch()}"
        }
    properties = torch.cuda.get_device_properties(0)
    return found | {
        "device": properties.name,
        "capability": f"{properties.major}.{properties.minor}",
        "memory_bytes": properties.total_memory,
        "multiprocessors": properties.multi_processor_count,
        "nvrtc": nvrtc(),
    }


def _other_torch() -> str:
    """Return what to type for a torch that runs with the driver of this machine."""
    from gpu_run.machine import NoGpuError, TroubleError, find_device, fitting_torch

    try:
        torch = fitting_torch(find_device().driver_cuda)
    except NoGpuError:
        torch = "torch"
    except TroubleError as error:
        return str(error)
    return f"Try: {sys.executable} -m pip install --force-reinstall '{torch}'"


def nvrtc() -> str | None:
    """Return the version and the path of the compiler of the kernels."""
    from cadam3d.rasterizer.nvrtc import find_compiler

    found = find_compiler()
    return f"{'.'.join(map(str, found.version))} in {found.path}" if found else None


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

    return explain(load_kernels(None), torch.device("cuda"), SCENES, REPEATS, COPY_BYTES)


def explain(launcher: Any, device: Any, scenes: Any, repeats: int, copied: int) -> dict[str, Any]:
    """Return the stages of scenes, as many as fit into memory."""
    from dataclasses import asdict

    from rasterizer_bench.scenes import make_scene, make_shell
    from rasterizer_bench.stages import NoKernelsError, copy_speed, time_stages
    from rasterizer_bench.timing import OUT_OF_MEMORY

    found, lacking, speed = [], [], copy_speed(device, copied)
    for count, size, views, degree in scenes:
        try:
            times = time_stages(
                launcher, make_scene(make_shell(count, degree, device), size, views), repeats, speed
            )
        except OUT_OF_MEMORY:
            lacking.append(f"{count} Gaussians at {size} px do not fit into the memory")
            continue
        except NoKernelsError as error:
            return {"says": str(error), "skipped": True}
        at = {"count": count, "size": size, "views": views, "degree": degree}
        found.append(at | {"wall_ms": times.wall_ms, "kernel_ms": times.kernel_ms})
        found[-1]["stages"] = [asdict(stage) for stage in times.stages]
    busy = [f"{each['kernel_ms']:.2f} of {each['wall_ms']:.2f} ms" for each in found]
    says = f"kernels take {', '.join(busy)}; a copy moves {speed / 1e9:.2f} TB/s"
    return {"says": "; ".join([says, *lacking]), "scenes": found, "copy_bytes_per_ms": speed}


def sorts() -> dict[str, Any]:
    """Time our sort beside that of torch."""
    import torch

    from cadam3d.rasterizer.cuda import load_kernels

    return compare_sorts(load_kernels(None), torch.device("cuda"), SORTS, REPEATS)


def compare_sorts(launcher: Any, device: Any, sizes: Any, repeats: int) -> dict[str, Any]:
    """Return the times of both sorts, which take turns."""
    import statistics

    from measuring import now
    from rasterizer_bench.check import make_keys, sort_keys
    from rasterizer_bench.timing import OUT_OF_MEMORY

    def took(work: Callable[[], object]) -> float:
        begin = now(device)
        work()
        return (now(device) - begin) * 1e3

    found, lacking = [], []
    for count, bits in sizes:
        try:
            keys, times = make_keys(count, min(bits, 31), device), []
            with launcher.on(device) as launch:
                for _ in range(repeats + 1):
                    ours = took(lambda keys=keys, bits=bits: sort_keys(launch, keys, bits))
                    times.append((ours, took(lambda keys=keys: keys.sort(stable=True))))
        except OUT_OF_MEMORY:
            lacking.append(f"{count} keys do not fit into the memory")
            continue
        # The first turn warms up and is not counted.
        ours, theirs = (statistics.median(each) for each in zip(*times[1:], strict=True))
        found.append({"keys": count, "bits": bits, "ours_ms": ours, "torch_ms": theirs})
    ratios = [f"{each['torch_ms'] / each['ours_ms']:.2f}x" for each in found]
    says = f"the speed of torch.sort(stable=True) times {', '.join(ratios)}"
    return {"says": "; ".join([says, *lacking]), "sorts": found}


def load() -> dict[str, Any]:
    """Render and differentiate the largest scene twice, for a profiler."""
    import torch
    from rasterizer_bench.scenes import make_scene, make_shell

    from cadam3d.rasterizer.cuda import CudaRasterizer

    count, size, views, degree = SCENES[-1]
    scene = make_scene(make_shell(count, degree, torch.device("cuda")), size, views)
    for _ in range(2):
        scene.zero_grad()
        scene.backward(scene.render(CudaRasterizer(cache_dir=None)))
    torch.cuda.synchronize()
    return {"says": "rendered"}


def ncu(tool: str) -> dict[str, Any]:
    """Count with Nsight Compute what the kernels of the largest scene do."""
    sections = [word for section in SECTIONS for word in ("--section", section)]
    command = [tool, "--clock-control", "none", *sections, "-k", COUNTED, "-c", str(COUNTED_KERNELS), "--csv"]
    command += [sys.executable, "-m", "gpu_run.on_device", "load"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    found = read_counters(done.stdout)
    if found:
        return {"says": f"counters of {len(found)} kernels at {SCENES[-1][0]:,} Gaussians", "counters": found}
    lines = [line.strip() for line in (done.stdout + done.stderr).splitlines() if line.strip()]
    errors = [line for line in lines if "ERR" in line or "error" in line.lower()]
    reason = (errors or lines or ["no output"])[-1 if not errors else 0]
    return {"says": f"ncu does not work on this machine: {reason}", "skipped": True}


def read_counters(text: str) -> list[dict[str, Any]]:
    """Return the metrics of each kernel in the CSV that ``ncu`` prints; of many launches, the longest one."""
    lines = [line for line in text.splitlines() if line.startswith('"')]
    launches: dict[str, dict[str, Any]] = {}
    for row in csv.DictReader(io.StringIO("\n".join(lines))):
        if row.get("Metric Name") in METRICS and row.get("ID") is not None:
            launch = launches.setdefault(
                row["ID"], {"kernel": row["Kernel Name"].partition("(")[0], "metrics": {}}
            )
            unit = row.get("Metric Unit") or ""
            launch["metrics"].setdefault(row["Metric Name"], f"{row['Metric Value']} {unit}".strip())
    longest: dict[str, dict[str, Any]] = {}
    for launch in launches.values():
        other = longest.get(launch["kernel"])
        if other is None or _duration(launch) > _duration(other):
            longest[launch["kernel"]] = launch
    return list(longest.values())


UNITS = {
    "ns": 1e-6,
    "nsecond": 1e-6,
    "us": 1e-3,
    "usecond": 1e-3,
    "ms": 1.0,
    "msecond": 1.0,
    "s": 1e3,
    "second": 1e3,
}


def _duration(launch: dict[str, Any]) -> float:
    """Return the milliseconds of a launch."""
    number, _, unit = launch["metrics"].get("Duration", "0 ms").partition(" ")
    return float(number.replace(",", "")) * UNITS.get(unit, 1.0)


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
    "load": load,
    "ncu": ncu,
    "stages": stages,
}


def main(words: list[str] | None = None) -> int:
    """Do one piece of work, write its result, and return the exit code: 1 if it shows a mistake."""
    parser = argparse.ArgumentParser("gpu_run.on_device", description=__doc__)
    parser.add_argument("name", choices=WORK)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--tool")
    args = parser.parse_args(words)
    try:
        result = WORK[args.name](*([args.tool] if args.tool else []))
    except Exception as error:
        # Whatever fails on an unknown machine becomes one line of the report; the log has the rest.
        import traceback

        traceback.print_exc()
        first = (str(error).strip().splitlines() or [""])[0]
        # A UserError is a sentence already.
        kind = type(error).__name__
        result = {"says": first if kind == "UserError" else f"{kind}: {first}", "failed": True}
    print(result.get("says", ""))
    if args.json:
        args.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return 1 if result.get("failed") else 0


if __name__ == "__main__":
    sys.exit(main())
