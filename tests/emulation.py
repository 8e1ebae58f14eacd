"""The CUDA kernels on fibers: the very source a GPU runs, compiled by the C++ compiler of this machine."""

import ctypes
import faulthandler
import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path

import pytest
import torch

from cadam3d.core.errors import UserError
from cadam3d.core.render import RenderOutput
from cadam3d.rasterizer import base
from cadam3d.rasterizer.build import CONSTANTS, KERNELS, find_compiler
from cadam3d.rasterizer.cuda import Launch, Launcher, rasterize
from cadam3d.rasterizer.driver import Module

SOURCE = Path(__file__).parent / "rasterizer" / "emulator" / "emulator.cpp"
FLAGS = ("-std=c++17", "-shared", "-fPIC", "-ffp-contract=off", "-U_FORTIFY_SOURCE")
FLAGS += ("-Wall", "-Wextra", "-Werror", "-Wno-unknown-pragmas")


class Emulator(Launcher):
    """Runs kernels on fibers, through the code that talks to a real driver."""

    def __init__(self, module: Module, seed: int) -> None:
        self.module, self.seed = module, seed

    @contextmanager
    def on(self, device: torch.device) -> Iterator[Launch]:
        """See :meth:`Launcher.on`; the seed of the schedule travels as the stream."""
        assert device.type == "cpu"
        with self.module.launching(self.seed) as launch:
            yield launch

    def render(self, gaussians, cameras, background, absgrad=False) -> RenderOutput:
        """See ``Rasterizer.render``."""
        return rasterize(self, gaussians, cameras, background, absgrad)

    def shuffled(self, seed: int) -> "Emulator":
        """The same kernels, in another order."""
        return Emulator(self.module, seed)


def compile_emulator(
    folder: Path, kernels: Path = KERNELS, optimize: str = "-O1", extra: tuple[str, ...] = ()
) -> Emulator:
    """Compile the kernels under ``kernels``; ``extra`` holds further flags of the compiler."""
    compiler = find_compiler()
    if compiler is None:
        pytest.skip("no C++ compiler")
    library = folder / "emulator.so"
    defines = [f"-DSPLAT_{name}={getattr(base, name)!r}" for name in CONSTANTS]
    paths = [optimize, *extra, f"-I{kernels}", str(SOURCE), "-o", str(library)]
    done = subprocess.run(
        [*compiler.command, *FLAGS, *defines, *paths], capture_output=True, text=True, check=False
    )
    if done.returncode != 0 and "ucontext.h" in done.stderr:
        pytest.skip("no ucontext.h")
    assert done.returncode == 0, done.stderr
    return Emulator(Module(ctypes.CDLL(str(library)), 0, b""), seed=1)


def is_acquitted(emulator: Emulator, judge: Callable[[Emulator], None]) -> bool:
    """In a process of its own: a mutant may write anywhere."""

    def trial() -> None:
        torch.set_num_threads(1)  # threads do not survive a fork
        faulthandler.disable()  # to crash is one way to be found guilty
        try:
            judge(emulator)
        except (AssertionError, UserError):
            os._exit(1)
        os._exit(0)

    process = get_context("fork").Process(target=trial)
    process.start()
    process.join(60)
    process.kill()  # no more than a mutant that never ends is left
    process.join()
    return process.exitcode == 0
