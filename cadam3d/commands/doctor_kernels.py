"""Kernels for ``cadam3d doctor``: how each rasterizer and the ray tracer was compiled, and its self-test."""

import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from importlib.metadata import PackageNotFoundError, version

import torch

from cadam3d.commands.finding import Finding, Verdict, attempt
from cadam3d.compiled import library
from cadam3d.core.cameras import turntable
from cadam3d.core.errors import UserError
from cadam3d.io.cache import kernels_dir
from cadam3d.prior.shapes import native_tracer
from cadam3d.prior.shapes.native_tracer import load_tracer, trace_natively
from cadam3d.prior.shapes.scene import build as scene_of
from cadam3d.prior.shapes.tracer import trace
from cadam3d.rasterizer import nvrtc
from cadam3d.rasterizer.auto import AutoRasterizer
from cadam3d.rasterizer.base import Rasterizer
from cadam3d.rasterizer.cpu import CpuRasterizer, cpu_library, instruction_set
from cadam3d.rasterizer.cuda import CudaRasterizer
from cadam3d.rasterizer.gsplat import GsplatRasterizer
from cadam3d.rasterizer.reference import ReferenceRasterizer
from cadam3d.rasterizer.selftest import ATOMIC, GSPLAT, OWN, Demands, self_test

CPU = torch.device("cpu")
TRACER = "prior.tracer=auto"
# Several kinds of solids. There is no pattern, because its borders may differ by a sample.
PROMPT = "a red mug next to a tree"
TOLERANCE = 1e-4  # of the light, in [0, 1]
# Failures that do not end a training, because auto chooses another backend then.
REPLACED = ("rasterizer=cuda", "rasterizer=gsplat")
REPORT = "Please report this. Until it is fixed, use {}"


def check_kernels() -> Iterator[Finding]:
    """Compile and test each backend on each device. ``auto`` is last because it would compile silently."""
    gpus = [torch.device("cuda", i) for i in range(torch.cuda.device_count())]
    yield from _compiled("cpu", _cpu_kernels, CpuRasterizer(cache_dir=None), CPU, OWN)
    for gpu in gpus:
        yield from _compiled("cuda", partial(_cuda_kernels, gpu), CudaRasterizer(cache_dir=None), gpu, OWN)
        yield from _compiled("gsplat", partial(_gsplat_kernels, gpu), GsplatRasterizer(), gpu, GSPLAT)
    if not gpus:
        yield attempt("kernels for cuda", _no_cuda)
        yield _gsplat_without_gpu()
    for device in (CPU, *gpus):
        demands = OWN if device == CPU else ATOMIC
        yield _tested("rasterizer=reference", ReferenceRasterizer(), device, demands)
    for device in (CPU, *gpus):
        yield attempt("rasterizer=auto", partial(_choice, device))
    yield attempt(TRACER, _tracer)


def _compiled(
    name: str,
    compiling: Callable[[], Finding],
    rasterizer: Rasterizer,
    device: torch.device,
    demands: Demands,
) -> Iterator[Finding]:
    """Yield how a backend was compiled, and its self-test if that succeeded."""
    kernels = attempt(f"kernels for {name}", compiling)
    yield kernels
    if kernels.verdict is Verdict.OK:
        yield _tested(f"rasterizer={name}", rasterizer, device, demands)


def _cpu_kernels() -> Finding:
    built = library.build(cpu_library(), kernels_dir(None))
    return Finding("kernels for cpu", Verdict.OK, _native(instruction_set(library.load(built)), built))


def _cuda_kernels(device: torch.device) -> Finding:
    name, capability = torch.cuda.get_device_name(device), torch.cuda.get_device_capability(device)
    built, compiler = nvrtc.build(kernels_dir(None), capability), nvrtc.find_compiler()
    assert compiler is not None, "build() has just used it"
    found = (
        f"sm_{nvrtc.choose_architecture(capability, compiler)} for {name} "
        f"(compute capability {dotted(capability)}) by NVRTC {dotted(compiler.version)} "
        f"in {compiler.path}, {when(built)}"
    )
    return Finding("kernels for cuda", Verdict.OK, found)


def _no_cuda() -> Finding:
    compiler = nvrtc.find_compiler()
    known = f"NVRTC {dotted(compiler.version)} is in {compiler.path}" if compiler else "no NVRTC was found"
    return Finding("kernels for cuda", Verdict.NOTE, f"torch sees no CUDA device; {known}")


def _gsplat_without_gpu() -> Finding:
    installed = _gsplat_version()
    found = f"gsplat {installed} is installed" if installed else "gsplat is not installed, not needed"
    return Finding("kernels for gsplat", Verdict.NOTE, f"torch sees no CUDA device; {found}")


def _gsplat_kernels(device: torch.device) -> Finding:
    start = time.perf_counter()
    GsplatRasterizer().prepare(device)
    seconds = time.perf_counter() - start
    found = f"gsplat {_gsplat_version()} for {torch.cuda.get_device_name(device)}, loaded in {seconds:.1f} s"
    return Finding("kernels for gsplat", Verdict.OK, found)


def _gsplat_version() -> str | None:
    try:
        return version("gsplat")
    except PackageNotFoundError:
        return None


def _tested(topic: str, rasterizer: Rasterizer, device: torch.device, demands: Demands) -> Finding:
    return attempt(topic, partial(_test, topic, rasterizer, device, demands))


def _test(topic: str, rasterizer: Rasterizer, device: torch.device, demands: Demands) -> Finding:
    agreement = self_test(rasterizer, device, demands)
    found = f"{agreement}, on {device}"
    if agreement.passes:
        return Finding(topic, Verdict.OK, found)
    verdict = Verdict.NOTE if topic in REPLACED else Verdict.BROKEN
    return Finding(topic, verdict, found, REPORT.format("rasterizer=reference"))


def _choice(device: torch.device) -> Finding:
    backend = AutoRasterizer().prepare(device)
    chosen = f"chooses {backend.name} on {device}"
    if backend.reason is None:
        return Finding("rasterizer=auto", Verdict.OK, f"{chosen}: the fastest there is, and it works")
    first, *others = backend.reason.splitlines()
    return Finding("rasterizer=auto", Verdict.NOTE, f"{chosen}: {first}", *others[-1:])


def _tracer() -> Finding:
    """Compile the native tracer and compare it with the one in torch; a note if it cannot be compiled."""
    try:
        built, tracer = load_tracer()
    except UserError as error:
        first, *others = str(error).splitlines()
        return Finding(TRACER, Verdict.NOTE, f"torch, which is slow: {first}", *others[-1:])
    scene = scene_of(PROMPT).to(CPU, torch.float32)
    views = turntable(2, elevation_deg=20.0, distance=3.0, fov_y_deg=40.0, size=32)
    ours, expected = trace_natively(tracer, scene, views, 2), trace(scene, views, 2)
    difference = float((ours.paints - expected.paints).abs().max())
    how = _native(native_tracer.instruction_set(tracer), built)
    if difference <= TOLERANCE:
        return Finding(TRACER, Verdict.OK, f"native, {how}; equals torch to {difference:.1g}")
    hint = REPORT.format("prior.tracer=torch")
    return Finding(TRACER, Verdict.BROKEN, f"native, {how}; differs by {difference:.1g}", hint)


def _native(instructions: str, built: library.Build) -> str:
    """Return how kernels for the CPU were compiled."""
    compiler = library.find_compiler()
    return f"{instructions} by {compiler.version if compiler else 'another compiler'}, {when(built)}"


def when(built: library.Build | nvrtc.Cubin) -> str:
    """Return where a compiled file is and whether it was compiled now."""
    how = f"compiled now in {built.seconds:.1f} s, kept in" if built.seconds else "from the cache in"
    return f"{how} {built.path.parent}"


def dotted(version: Sequence[int]) -> str:
    """Return a version as text, such as ``12.4``."""
    return ".".join(map(str, version))
