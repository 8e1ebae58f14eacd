"""Run the CUDA kernels on a CPU: the same source, compiled by a C++ compiler, with one fiber per thread."""

import ctypes
import faulthandler
import hashlib
import os
import platform
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import pytest
import torch
from filelock import FileLock

from cadam3d.compiled.library import find_compiler
from cadam3d.core.cameras import Cameras
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.rendering import RenderOutput
from cadam3d.rasterizer import cuda, workspace
from cadam3d.rasterizer.base import KERNELS, definitions
from cadam3d.rasterizer.cuda import rasterize
from cadam3d.rasterizer.cuda_sort import scan, scan_bytes, sort, sort_bytes
from cadam3d.rasterizer.driver import Launch, Launcher, Module
from cadam3d.rasterizer.workspace import Workspace

SOURCE = Path(__file__).parent / "rasterizer" / "emulator" / "emulator.cpp"
FLAGS = ("-std=c++17", "-shared", "-fPIC", "-ffp-contract=off", "-U_FORTIFY_SOURCE")
FLAGS += ("-Wall", "-Wextra", "-Werror", "-Wno-unknown-pragmas")


class Emulator(Launcher):
    """Launches kernels on fibers, through the same Python code that calls a real CUDA driver."""

    def __init__(self, library: ctypes.CDLL, seed: int = 1) -> None:
        self.library, self.module, self.seed = library, Module(library, 0, b""), seed

    @contextmanager
    def on(self, device: torch.device) -> Iterator[Launch]:
        """See :meth:`Launcher.on`. The seed of the schedule is passed as the handle of the stream."""
        assert device.type == "cpu"
        with self.module.launching(self.seed) as launch:
            yield launch

    def render(self, gaussians, cameras, background, absgrad=False) -> RenderOutput:
        """See ``Rasterizer.render``."""
        return rasterize(self, gaussians, cameras, background, absgrad)

    def shuffled(self, seed: int) -> "Emulator":
        """Return the same kernels with another schedule of their threads."""
        return Emulator(self.library, seed)

    def activate(self, mutant: int) -> None:
        """Switch on a planted mistake by its number (see mutants.py); 0 switches all of them off."""
        ctypes.c_int.in_dll(self.library, "active_mutant").value = mutant


def scan_tensor(launch: Launch, values: torch.Tensor, index: torch.Tensor | None = None) -> torch.Tensor:
    """Return the exclusive prefix sums of ``values``, or of ``values[index]``, and behind them the total."""
    n = (values if index is None else index).shape[0]
    sums = torch.empty(n + 1, dtype=torch.int32, device=values.device)
    temporary = torch.empty(scan_bytes(n), dtype=torch.uint8, device=values.device)
    where = 0 if index is None else index.data_ptr()
    scan(launch, values.data_ptr(), sums.data_ptr(), n, temporary.data_ptr(), where, sums[n:].data_ptr())
    return sums


def sort_tensor(
    launch: Launch, keys: torch.Tensor, bit_count: int, total: int | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the sorted keys and their old positions. ``total`` is the number of keys on the device."""
    n, keys, order = keys.shape[0], keys.clone(), torch.empty_like(keys)
    temporary = [keys.new_empty(size, dtype=torch.uint8) for size in sort_bytes(n, bit_count)]
    count = keys.new_tensor([n if total is None else total])
    at, counted = [tensor.data_ptr() for tensor in temporary], 0 if total is None else count.data_ptr()
    found = sort(launch, keys.data_ptr(), order.data_ptr(), n, bit_count, at, counted)
    block = next(block for block in (keys, *temporary) if block.data_ptr() == found)
    return block.view(torch.int32)[:n], order


def as_unsigned(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.long() & 0xFFFFFFFF


def as_signed(values: torch.Tensor) -> torch.Tensor:
    """Return numbers below 2**32 as the int32 with the same bits."""
    return torch.where(values < 2**31, values, values - 2**32).int()


def check_sort(emulator: Emulator, n: int, distinct: int, bit_count: int) -> None:
    """Compare a sort of random keys with the one of torch."""
    values = torch.randint(0, 2**bit_count, (distinct,), generator=torch.Generator().manual_seed(n))
    picks = torch.randint(0, distinct, (n,), generator=torch.Generator().manual_seed(n + 1))
    keys = values[picks]
    with emulator.on(torch.device("cpu")) as launch:
        got, order = sort_tensor(launch, as_signed(keys), bit_count)
    want, want_order = keys.sort(stable=True)
    assert torch.equal(as_unsigned(got), want)
    assert torch.equal(order.long(), want_order)


@dataclass(frozen=True)
class Lists:
    """Splats and tile lists of views that are one group; see cuda.py."""

    splats: torch.Tensor  # [pairs SPLAT]
    counts: torch.Tensor  # [pairs]
    first_slot: torch.Tensor  # [pairs]
    is_seen: torch.Tensor  # [pairs]
    slots: torch.Tensor  # [slots]
    pair_of_slot: torch.Tensor  # [slots]
    ranges: torch.Tensor  # [tiles + 1, 2]


def count_slots(launcher: Launcher, gaussians: Gaussians, cameras: Cameras) -> list[int]:
    """Return the number of slots of each view."""
    views = cuda._CudaPass(launcher, cameras, torch.device("cpu"))
    with views:
        views.project(list(gaussians.tensors().values()))
    return views.read_slots()


def list_tiles(launcher: Launcher, gaussians: Gaussians, cameras: Cameras) -> Lists:
    """Project the Gaussians and return the tile lists."""
    parameters = list(gaussians.tensors().values())
    views = cuda._CudaPass(launcher, cameras, torch.device("cpu"))
    with views:
        _, radii = views.project(parameters)
        views.blend(parameters, torch.zeros(len(cameras), 3), keeps=True)
        (group,), kept = views.groups, views.kept

    def array(name: str, dtype: torch.dtype = torch.int32) -> torch.Tensor:
        if name in group.lists.places:
            return group.lists.tensor(kept[group.blocks], name, dtype)
        return views.frame.tensor(kept, name, dtype)

    return Lists(
        splats=array("splats", torch.float32).view(-1, cuda.SPLAT),
        is_seen=radii.flatten() > 0,
        ranges=array("ranges").view(-1, 2),
        **{name: array(name) for name in ("counts", "first_slot", "slots", "pair_of_slot")},
    )


@contextmanager
def guard_zones() -> Iterator[Callable[[], bool]]:
    """Give each array of a workspace an allocation of its own, between two zones that nothing may write.

    Yield a function that returns whether all zones are intact. At first the arrays contain small numbers. The
    largest number would be less harmful, because it cannot be mistaken for an index.
    """
    zone, mark, found = 256, 0xA5, []

    def allocate(self: Workspace, device: torch.device) -> tuple[torch.Tensor, ...]:
        blocks = []
        for size in self.blocks:
            whole = torch.full((size + 2 * zone,), mark, dtype=torch.uint8, device=device)
            garbage = torch.arange(-(-size // 4), dtype=torch.int32, device=device).view(torch.uint8)
            whole[zone : zone + size] = garbage[:size]
            found.append(whole)
            blocks.append(whole[zone : zone + size])
        return tuple(blocks)

    def intact() -> bool:
        return all((end == mark).all() for whole in found for end in (whole[:zone], whole[-zone:]))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(workspace, "APART", True)
        patch.setattr(Workspace, "allocate", allocate)
        yield intact


def load_emulator(folder: Path, kernels: Path = KERNELS, optimize: str = "-O1") -> Emulator:
    """Return the kernels under ``kernels``, compiled into ``folder`` unless they are there."""
    return Emulator(ctypes.CDLL(str(build_emulator(folder, kernels, optimize))))


def build_emulator(folder: Path, kernels: Path, optimize: str, extra: tuple[str, ...] = ()) -> Path:
    """Return the library in ``folder``, and compile it if it is missing; ``extra`` holds more flags."""
    compiler = find_compiler()
    if compiler is None:
        pytest.skip("no C++ compiler")
    flags = [*FLAGS, optimize, *extra, *definitions()]
    sources = sorted([*kernels.iterdir(), *SOURCE.parent.glob("*.h"), SOURCE], key=lambda path: path.name)
    key = content_hash(compiler.version, platform.machine(), *flags, *(path.read_text() for path in sources))

    def compile_to(path: Path) -> None:
        command = [*compiler.command, *flags, f"-I{kernels}", str(SOURCE), "-o", str(path)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0 and "ucontext.h" in done.stderr:
            pytest.skip("no ucontext.h")
        assert done.returncode == 0, done.stderr

    return make_once(folder / f"emulator-{key}.so", compile_to)


def content_hash(*parts: str) -> str:
    """Return a short hash of some texts."""
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]


def make_once(path: Path, make: Callable[[Path], None]) -> Path:
    """Return ``path``. If it is missing, ``make`` writes it, while other test processes wait for it."""
    with FileLock(path.with_suffix(".lock")):
        if not path.exists():
            with tempfile.TemporaryDirectory(dir=path.parent) as folder:
                unfinished = Path(folder) / path.name
                make(unfinished)
                unfinished.replace(path)
    return path


def passes(emulator: Emulator, judge: Callable[[Emulator], None], mutant: int = 0) -> bool:
    """Return whether ``judge`` finds nothing wrong, in another process: a mutant may write anywhere."""

    def trial() -> None:
        torch.set_num_threads(1)  # threads do not survive a fork
        faulthandler.disable()  # a crash is an expected verdict
        emulator.activate(mutant)
        try:
            judge(emulator)
        except (AssertionError, UserError):
            os._exit(1)
        os._exit(0)

    process = get_context("fork").Process(target=trial)
    process.start()
    process.join(60)
    # A mutant may never end.
    process.kill()
    process.join()
    return process.exitcode == 0
