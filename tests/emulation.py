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
from multiprocessing import get_context
from pathlib import Path

import pytest
import torch
from filelock import FileLock

from cadam3d.compiled.build import find_compiler
from cadam3d.core.errors import UserError
from cadam3d.core.render import RenderOutput
from cadam3d.rasterizer.cuda import rasterize
from cadam3d.rasterizer.driver import Module
from cadam3d.rasterizer.launcher import Launch, Launcher
from cadam3d.rasterizer.sources import KERNELS, definitions

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
