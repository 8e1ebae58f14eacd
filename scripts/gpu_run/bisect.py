"""Find the first stage of the CUDA kernels that is wrong: compare their memory with that of the emulator.

The emulator runs the same kernels on the CPU, launch after launch in the same order, and every new array is
filled with the same bytes. So after each launch all arrays must agree: numbers that decide something to the
bit, and others up to the rounding of the device's own functions.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import gettempdir
from typing import Any

import torch
from rasterizer_bench.check import difficult_scenes
from rasterizer_bench.scenes import Scene
from rasterizer_bench.scenes import make_scene as bench_scene
from rasterizer_bench.stages import KernelRasterizer, stages_of
from torch import Tensor

from cadam3d.core.gaussians import FIELDS
from cadam3d.rasterizer.driver import Launch, Launcher
from cadam3d.rasterizer.selftest import IMAGES
from cadam3d.rasterizer.selftest import make_scene as self_test_scene
from cadam3d.rasterizer.workspace import Workspace

TESTS = Path(__file__).parents[2] / "tests"
# Arrays of floats, and the keys, which are the bits of floats; all other arrays are whole numbers.
FLOATS = ("cameras", "splats", "depth_keys", "transmittance", "records", "absolutes", "axes")
# What is left in these depends on the passes of a sort. Its result is in other arrays.
IGNORED = ("temporary", "sums_of_chunks")
# Relative to the largest number of an array.
MOST = 1e-3
# The scene of the self-test has no number near a step of the image formation. In others, rounding decides
# about some pixels, so this share of an array may differ.
SHARE = 0.01
# Scenes after that of the self-test, and their pixels: opaque stacks, and splats in very many tiles.
DIFFICULT = {"opaque": 45, "each fills the screen": 96}
# Where results of torch come from that are in no array of the kernels.
RESULTS = {
    "project": ("means2d", "radii"),
    "blend forward": IMAGES,
    "project backward": (*(f"gradient of {name}" for name in (*FIELDS, "means2d")), "absgrad"),
}


@dataclass(frozen=True)
class Moment:
    """The arrays after one launch."""

    kernel: str
    arrays: dict[str, Tensor]
    trouble: str | None = None  # the message, if the launch failed


@dataclass
class Run:
    """All launches of a forward and a backward pass, and the results."""

    moments: list[Moment] = field(default_factory=list)
    results: dict[str, Tensor] = field(default_factory=dict)


class Recorder(Launcher):
    """Passes every launch on, and copies all arrays after it."""

    def __init__(self, inner: Launcher, run: Run) -> None:
        self._inner, self._run = inner, run
        self._arrays: list[tuple[Workspace, tuple[Tensor, ...]]] = []

    @contextmanager
    def on(self, device: torch.device) -> Iterator[Launch]:
        """See :meth:`Launcher.on`."""
        with self._inner.on(device) as launch:
            yield partial(self._launch, launch, device)

    def _launch(self, launch: Launch, device: torch.device, kernel: str, *arguments: int) -> None:
        try:
            launch(kernel, *arguments)
            if device.type == "cuda":
                torch.cuda.synchronize(device)
        except Exception as error:
            self._run.moments.append(Moment(kernel, {}, f"{error}".splitlines()[0]))
            raise
        arrays = {
            f"{number} {name}": workspace.tensor(blocks, name, torch.uint8).cpu().clone()
            for number, (workspace, blocks) in enumerate(self._arrays)
            for name in workspace.places
            if not name.startswith(IGNORED)
        }
        self._run.moments.append(Moment(kernel, arrays))

    @contextmanager
    def noting(self) -> Iterator[None]:
        """Note all memory of the kernels, and fill new memory with the same bytes everywhere."""
        allocate = Workspace.allocate

        def note(workspace: Workspace, device: torch.device) -> tuple[Tensor, ...]:
            blocks = allocate(workspace, device)
            self._arrays.append((workspace, blocks))
            return blocks

        mode = torch.get_deterministic_debug_mode()
        Workspace.allocate = note
        torch.set_deterministic_debug_mode("warn")
        try:
            yield
        finally:
            Workspace.allocate = allocate
            torch.set_deterministic_debug_mode(mode)


def record(launcher: Launcher, device: torch.device, scene: Scene, absgrad: bool) -> Run:
    """Return everything that the kernels write for the scene, up to the first launch that fails."""
    run = Run()
    recorder = Recorder(launcher, run)
    scene = scene.to(device, torch.float32)
    with recorder.noting():
        try:
            output = KernelRasterizer(recorder).render(
                scene.gaussians, scene.cameras, scene.background, absgrad
            )
            images = (output.rgb, output.alpha, output.depth)
            scene.backward(images)
        except Exception:
            if run.moments and run.moments[-1].trouble:
                return run
            raise
    run.results = {name: getattr(output, name).detach() for name in (*IMAGES, "radii")}
    # A centre that is not seen is arbitrary.
    run.results["means2d"] = torch.where(output.visible[..., None], output.means2d.detach(), 0.0)
    leaves = scene.gaussians.tensors() | {"means2d": output.means2d}
    run.results |= {f"gradient of {name}": tensor.grad for name, tensor in leaves.items()}
    if absgrad:
        run.results["absgrad"] = output.absgrad.grad
    run.results = {name: tensor.cpu() for name, tensor in run.results.items()}
    return run


def first_difference(got: Run, want: Run, share: float) -> tuple[str, str] | None:
    """Return the first stage that differs, and how; ``None`` if both runs agree.

    This ``share`` of an array may differ.
    """
    stages = stages_of([moment.kernel for moment in want.moments])
    for number, (ours, theirs) in enumerate(zip(got.moments, want.moments, strict=False), start=1):
        stage, where = stages[number - 1], f"{theirs.kernel}, launch {number} of {len(want.moments)}"
        if ours.trouble:
            return stage, f"{where}: {ours.trouble}"
        if ours.kernel != theirs.kernel:
            return stage, f"launch {number} is {ours.kernel} instead of {theirs.kernel}"
        for name, array in theirs.arrays.items():
            plain = name.partition(" ")[2]
            if trouble := deviation(ours.arrays.get(name), array, plain, share):
                return stage, f"{where}: {plain} {trouble}"
    if len(got.moments) != len(want.moments):
        return stages[len(got.moments)], f"{len(got.moments)} launches instead of {len(want.moments)}"
    for stage, names in RESULTS.items():
        for name in names:
            if name in want.results and (
                trouble := deviation(got.results[name], want.results[name], name, share)
            ):
                return stage, f"{name} {trouble}"
    return None


def deviation(got: Tensor | None, want: Tensor, name: str, share: float) -> str | None:
    """Return how two arrays differ, in words; ``None`` if they agree except for a ``share`` of them."""
    if got is None or got.shape != want.shape:
        return "has another size"
    is_float = want.dtype != torch.uint8 or name in FLOATS
    dtype = torch.float32 if is_float else torch.int32
    got, want = (each.view(dtype) if each.dtype == torch.uint8 else each for each in (got, want))
    got, want = got.flatten(), want.flatten()
    if not is_float:
        count = int((got != want).sum())
        # Of the whole numbers, only this one depends on a comparison of rounded numbers.
        most = share * len(want) if name == "last" else 0
        return f"has {count} of {len(want)} wrong numbers" if count > most else None
    if not torch.equal(got.isfinite(), want.isfinite()):
        return "has numbers that are not finite, or too few of them"
    is_finite = want.isfinite()
    got, want = got[is_finite].double(), want[is_finite].double()
    error = (got - want).abs().sort(descending=True).values[int(share * len(want)) :]
    relative = float(error[0] / want.abs().max().clamp_min(1e-30)) if len(error) else 0.0
    return f"is wrong by {relative:.1e} of its largest number" if relative > MOST else None


def scenes() -> Iterator[tuple[Scene, float]]:
    """Yield scenes on the CPU, and the share of their numbers about which rounding decides."""
    plain = self_test_scene()
    yield Scene(plain.gaussians, plain.cameras, plain.background, tuple(map(plain.weights.get, IMAGES))), 0.0
    difficult = dict(difficult_scenes(torch.device("cpu")))
    for kind, size in DIFFICULT.items():
        yield bench_scene(difficult[kind], size, views=1), SHARE


def find_stage(launcher: Launcher, device: torch.device, truth: Launcher | None = None) -> dict[str, Any]:
    """Return the first stage that is wrong on the device, compared with the emulator.

    The emulator needs a C++ compiler.
    """
    truth = truth or load_truth()
    for scene, share in scenes():
        for absgrad in (False, True):
            want = record(truth, torch.device("cpu"), scene, absgrad)
            if found := first_difference(record(launcher, device, scene, absgrad), want, share):
                stage, how = found
                return {"says": f"the first wrong stage is {stage}: {how}", "stage": stage}
    return {"says": "every stage agrees with the emulator, up to rounding", "stage": None}


def load_truth() -> Launcher:
    """Return the emulator of the tests."""
    sys.path.insert(0, str(TESTS))
    from emulation import load_emulator

    folder = Path(gettempdir()) / "cadam3d-emulator"
    folder.mkdir(mode=0o700, exist_ok=True)
    return load_emulator(folder)
