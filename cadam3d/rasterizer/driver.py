"""Run compiled kernels through the CUDA driver, on torch's current stream and in torch's own context.

:class:`Launcher` is the interface between the CUDA rasterizer and whatever executes its kernels.
"""

import ctypes
import struct
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from pathlib import Path

import torch

from cadam3d.core.errors import UserError
from cadam3d.rasterizer.nvrtc import build

# launch(kernel, blocks, threads, *arguments) starts ``blocks`` blocks of ``threads`` threads. An argument is
# a whole number. An array is passed as its address, and an array that is left out as 0.
Launch = Callable[..., None]
LIBRARY = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
OUT_OF_MEMORY = 2  # CUDA_ERROR_OUT_OF_MEMORY
# Errors that every later call returns after any kernel of the process has failed: an illegal address, a
# timeout, an assertion, and the errors of the hardware.
STICKY = (700, 702, 710, *range(714, 720))
# Labels in the list of extra options of a launch: CU_LAUNCH_PARAM_END and so on.
END, BUFFER_POINTER, BUFFER_SIZE = 0, 1, 2
# By number of arguments: the function that writes them into a buffer, as whole numbers of eight bytes.
MOST_ARGUMENTS = 32
PACKERS = [struct.Struct(f"{count}q").pack_into for count in range(MOST_ARGUMENTS + 1)]


class Launcher(ABC):
    """Executes compiled kernels: on a GPU through the CUDA driver, or in the emulator of the tests."""

    @abstractmethod
    def on(self, device: torch.device) -> AbstractContextManager[Launch]:
        """Yield the :data:`Launch` function for ``device`` and its current stream."""


class Driver(Launcher):
    """Launches kernels on every CUDA device; the first use of a device compiles and loads them."""

    def __init__(self, cache_dir: Path) -> None:
        self._cache_dir = cache_dir
        self._modules: dict[int, Module] = {}

    def on(self, device: torch.device) -> AbstractContextManager[Launch]:
        """See :meth:`Launcher.on`. Raises :class:`UserError` if the kernels do not compile or load."""
        current = torch.cuda.current_device()
        index = current if device.index is None else device.index
        # Switching to another device takes longer than a launch, and usually none is needed.
        return self._launching(index) if index == current else self._on_another(index)

    @contextmanager
    def _on_another(self, index: int) -> Iterator[Launch]:
        with torch.cuda.device(index), self._launching(index) as launch:
            yield launch

    def _launching(self, index: int) -> AbstractContextManager[Launch]:
        if index not in self._modules:
            cubin = build(self._cache_dir, torch.cuda.get_device_capability(index))
            self._modules[index] = Module(load_driver(), index, cubin.read_bytes())
        return self._modules[index].launching(torch.cuda.current_stream(index).cuda_stream)


def load_driver() -> ctypes.CDLL:
    """Return the library of the CUDA driver. Raises :class:`UserError` if there is none."""
    try:
        return ctypes.CDLL(LIBRARY)
    except OSError as error:
        raise UserError(f"rasterizer=cuda cannot load the driver: {error}. Try: nvidia-smi") from error


class Module:
    """Compiled kernels in the memory of one device."""

    def __init__(self, driver: ctypes.CDLL, index: int, cubin: bytes) -> None:
        self.driver, self.find = driver, cache(self._find)
        # The same library for calls that take microseconds. They keep Python's lock: a busy thread that gets
        # it in between may keep it for milliseconds, up to 19 times per step.
        self.quick = ctypes.PyDLL(driver._name, handle=driver._handle)
        self._context, self._handle, ordinal = ctypes.c_void_p(), ctypes.c_void_p(), ctypes.c_int()
        self._popped = ctypes.pointer(ctypes.c_void_p())
        # Launch functions that are not in use at the moment.
        self.idle: list[_Launch] = []
        self._call("cuInit", 0)
        self._call("cuDeviceGet", ctypes.byref(ordinal), index)
        # Torch uses this context too. It is never released, because it lives as long as the process.
        self._call("cuDevicePrimaryCtxRetain", ctypes.byref(self._context), ordinal)
        self.push()
        try:
            self._call("cuModuleLoadData", ctypes.byref(self._handle), cubin)
        finally:
            self.pop()

    def launching(self, stream: int) -> AbstractContextManager[Launch]:
        """Return a context with the launch function (see :meth:`Launcher.on`) for a stream of the device."""
        # Autograd runs the backward pass in another thread, and two threads must not share a buffer. A look
        # at the list before the pop would be useless, because another thread may come in between.
        try:
            launch = self.idle.pop()
        except IndexError:
            launch = _Launch(self)
        launch.stream.value = stream
        return launch

    def _find(self, kernel: str) -> ctypes.c_void_p:
        """Request the handle of a kernel from the driver."""
        function = ctypes.c_void_p()
        self._call("cuModuleGetFunction", ctypes.byref(function), self._handle, kernel.encode())
        return function

    def push(self) -> None:
        """Make the context of the device current in this thread, which may not have one yet."""
        self.check("cuCtxPushCurrent_v2", self.quick.cuCtxPushCurrent_v2(self._context))

    def pop(self) -> None:
        """Undo :meth:`push`."""
        self.check("cuCtxPopCurrent_v2", self.quick.cuCtxPopCurrent_v2(self._popped))

    def check(self, name: str, status: int) -> None:
        """Raise an error that quotes the driver, unless ``status`` is 0."""
        if status == 0:
            return
        message = ctypes.c_char_p()
        self.driver.cuGetErrorString(status, ctypes.byref(message))
        reason = (message.value or b"error").decode()
        if status == OUT_OF_MEMORY:
            raise MemoryError(f"rasterizer=cuda: {name}: {reason}")
        if status in STICKY:
            raise UserError(
                f"CUDA: some kernel of this process failed before {name}: {reason} ({status}). "
                "Try: CUDA_LAUNCH_BLOCKING=1 in the environment, which shows where"
            )
        raise UserError(f"rasterizer=cuda: {name}: {reason} ({status}). Try: rasterizer=reference")

    def _call(self, name: str, *arguments: object) -> None:
        self.check(name, getattr(self.driver, name)(*arguments))


class _Launch:
    """Launches kernels on ``stream``, as a context in which the device is current for the driver.

    The arguments are packed into one buffer, which the driver copies. So a launch takes about a microsecond
    of Python. The driver's function has no ``argtypes``, because with them ctypes would check eleven
    arguments each time. Therefore handles and addresses are ``c_void_p``: a bare number is passed with 32
    bits.
    """

    def __init__(self, module: Module) -> None:
        self.stream = ctypes.c_void_p()
        self._module, self._find, self._call = module, module.find, module.quick.cuLaunchKernel
        self._buffer, self._size = ctypes.create_string_buffer(8 * MOST_ARGUMENTS), ctypes.c_size_t()
        buffer, size = ctypes.addressof(self._buffer), ctypes.addressof(self._size)
        self._extra = (ctypes.c_void_p * 5)(BUFFER_POINTER, buffer, BUFFER_SIZE, size, END)

    def __enter__(self) -> Launch:
        self._module.push()
        return self

    def __exit__(self, *_: object) -> None:
        self._module.pop()
        self._module.idle.append(self)

    def __call__(self, kernel: str, blocks: int, threads: int, *arguments: int) -> None:
        count = len(arguments)
        PACKERS[count](self._buffer, 0, *arguments)
        self._size.value = 8 * count
        function, stream, extra = self._find(kernel), self.stream, self._extra
        status = self._call(function, blocks, 1, 1, threads, 1, 1, 0, stream, None, extra)
        if status != 0:
            self._module.check("cuLaunchKernel", status)
