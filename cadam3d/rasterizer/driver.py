"""Run compiled kernels through the CUDA driver, on torch's current stream and in torch's own context."""

import ctypes
import struct
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path

import torch

from cadam3d.core.errors import UserError
from cadam3d.rasterizer.launcher import Launch, Launcher
from cadam3d.rasterizer.nvrtc import build

LIBRARY = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
OUT_OF_MEMORY = 2  # CUDA_ERROR_OUT_OF_MEMORY
# Labels in the list of extra options of a launch: CU_LAUNCH_PARAM_END and so on.
END, BUFFER_POINTER, BUFFER_SIZE = 0, 1, 2
# Functions that write so many whole numbers of eight bytes into a buffer.
MOST_ARGUMENTS = 32
PACKERS = [struct.Struct(f"{count}q").pack_into for count in range(MOST_ARGUMENTS + 1)]


class Driver(Launcher):
    """Launches kernels on every CUDA device; the first use of a device compiles and loads them."""

    def __init__(self, cache_dir: Path) -> None:
        self._cache_dir = cache_dir
        self._modules: dict[int, Module] = {}

    @contextmanager
    def on(self, device: torch.device) -> Iterator[Launch]:
        """See :meth:`Launcher.on`. Raises :class:`UserError` if the kernels do not compile or load."""
        current = torch.cuda.current_device()
        index = current if device.index is None else device.index
        # Switching takes longer than a launch, and usually the device is current already.
        with nullcontext() if index == current else torch.cuda.device(index):
            if index not in self._modules:
                cubin = build(self._cache_dir, torch.cuda.get_device_capability(index))
                self._modules[index] = Module(load_driver(), index, cubin.path.read_bytes())
            with self._modules[index].launching(torch.cuda.current_stream(index).cuda_stream) as launch:
                yield launch


def load_driver() -> ctypes.CDLL:
    """Return the library of the CUDA driver. Raises :class:`UserError` if there is none."""
    try:
        return ctypes.CDLL(LIBRARY)
    except OSError as error:
        raise UserError(f"rasterizer=cuda cannot load the driver: {error}. Try: nvidia-smi") from error


class Module:
    """Compiled kernels in the memory of one device."""

    def __init__(self, driver: ctypes.CDLL, index: int, cubin: bytes) -> None:
        self._driver, self._functions = driver, _Functions(self._find)
        self._context, self._handle, ordinal = ctypes.c_void_p(), ctypes.c_void_p(), ctypes.c_int()
        # Launch functions that no context uses at the moment.
        self._idle: list[_Launch] = []
        self._call("cuInit", 0)
        self._call("cuDeviceGet", ctypes.byref(ordinal), index)
        # Torch uses this context too. It is never released, because it lives as long as the process.
        self._call("cuDevicePrimaryCtxRetain", ctypes.byref(self._context), ordinal)
        with self._current():
            self._call("cuModuleLoadData", ctypes.byref(self._handle), cubin)

    @contextmanager
    def launching(self, stream: int) -> Iterator[Launch]:
        """Yield the launch function (see :meth:`Launcher.on`) for a stream of the device."""
        # Autograd runs the backward pass in another thread, and two threads must not share a buffer.
        launch = self._idle.pop() if self._idle else _Launch(self._driver, self._functions, self._check)
        launch.stream.value = stream
        with self._current():
            yield launch
        self._idle.append(launch)

    def _find(self, kernel: str) -> ctypes.c_void_p:
        function = ctypes.c_void_p()
        self._call("cuModuleGetFunction", ctypes.byref(function), self._handle, kernel.encode())
        return function

    @contextmanager
    def _current(self) -> Iterator[None]:
        # The threads of autograd may not have a context yet.
        self._call("cuCtxPushCurrent_v2", self._context)
        try:
            yield
        finally:
            self._call("cuCtxPopCurrent_v2", ctypes.byref(ctypes.c_void_p()))

    def _call(self, name: str, *arguments: object) -> None:
        status = getattr(self._driver, name)(*arguments)
        if status != 0:
            self._check(name, status)

    def _check(self, name: str, status: int) -> None:
        """Raise an error that quotes the driver, unless ``status`` is 0."""
        if status == 0:
            return
        message = ctypes.c_char_p()
        self._driver.cuGetErrorString(status, ctypes.byref(message))
        reason = (message.value or b"error").decode()
        if status == OUT_OF_MEMORY:
            raise MemoryError(f"rasterizer=cuda: {name}: {reason}")
        raise UserError(f"rasterizer=cuda: {name}: {reason} ({status}). Try: rasterizer=reference")


class _Functions(dict[str, ctypes.c_void_p]):
    """The handles of kernels by name, each of which the driver is asked for once."""

    def __init__(self, find: Callable[[str], ctypes.c_void_p]) -> None:
        super().__init__()
        self._find = find

    def __missing__(self, kernel: str) -> ctypes.c_void_p:
        self[kernel] = self._find(kernel)
        return self[kernel]


class _Launch:
    """Launches kernels on ``stream``. The arguments are packed into one buffer, which the driver copies.

    A launch takes about a microsecond of Python, half of the time that a list of pointers would take. The
    driver's function has no ``argtypes``: with them, ctypes would check eleven arguments each time. Handles and
    addresses are ``c_void_p`` therefore, because a bare number would be passed with 32 bits.
    """

    def __init__(
        self,
        driver: ctypes.CDLL,
        functions: Mapping[str, ctypes.c_void_p],
        check: Callable[[str, int], None],
    ) -> None:
        self.stream = ctypes.c_void_p()
        self._call, self._functions, self._check = driver.cuLaunchKernel, functions, check
        self._buffer, self._size = ctypes.create_string_buffer(8 * MOST_ARGUMENTS), ctypes.c_size_t()
        buffer, size = ctypes.addressof(self._buffer), ctypes.addressof(self._size)
        self._extra = (ctypes.c_void_p * 5)(BUFFER_POINTER, buffer, BUFFER_SIZE, size, END)

    def __call__(self, kernel: str, blocks: int, threads: int, *arguments: int) -> None:
        count = len(arguments)
        PACKERS[count](self._buffer, 0, *arguments)
        self._size.value = 8 * count
        function, grid = self._functions[kernel], (blocks, 1, 1, threads, 1, 1)
        status = self._call(function, *grid, 0, self.stream, None, self._extra)
        if status != 0:
            self._check("cuLaunchKernel", status)
