"""Run compiled kernels through the CUDA driver, on torch's current stream and in torch's own context."""

import ctypes
import struct
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import torch

from cadam3d.core.errors import UserError
from cadam3d.rasterizer.launcher import Launch, Launcher
from cadam3d.rasterizer.nvrtc import build

LIBRARY = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
OUT_OF_MEMORY = 2  # CUDA_ERROR_OUT_OF_MEMORY
# Labels in the list of extra options of a launch: CU_LAUNCH_PARAM_END and so on.
END, BUFFER_POINTER, BUFFER_SIZE = 0, 1, 2


class Driver(Launcher):
    """Launches kernels on every CUDA device; the first use of a device compiles and loads them."""

    def __init__(self, cache_dir: Path) -> None:
        self._cache_dir = cache_dir
        self._modules: dict[int, Module] = {}

    @contextmanager
    def on(self, device: torch.device) -> Iterator[Launch]:
        """See :meth:`Launcher.on`. Raises :class:`UserError` if the kernels do not compile or load."""
        index = torch.cuda.current_device() if device.index is None else device.index
        with torch.cuda.device(index):
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
        self._driver = driver
        self._functions: dict[str, ctypes.c_void_p] = {}
        self._context, self._handle, ordinal = ctypes.c_void_p(), ctypes.c_void_p(), ctypes.c_int()
        self._call("cuInit", 0)
        self._call("cuDeviceGet", ctypes.byref(ordinal), index)
        # Torch uses this context too. It is never released, because it lives as long as the process.
        self._call("cuDevicePrimaryCtxRetain", ctypes.byref(self._context), ordinal)
        with self._current():
            self._call("cuModuleLoadData", ctypes.byref(self._handle), cubin)

    @contextmanager
    def launching(self, stream: int) -> Iterator[Launch]:
        """Yield the launch function (see :meth:`Launcher.on`) for a stream of the device."""
        with self._current():
            yield partial(self._launch, ctypes.c_void_p(stream))

    def _launch(
        self, stream: ctypes.c_void_p, kernel: str, blocks: int, threads: int, *arguments: int
    ) -> None:
        packed = struct.pack(f"{len(arguments)}q", *arguments)
        size = ctypes.c_size_t(len(packed))
        extra = (ctypes.c_void_p * 5)(
            BUFFER_POINTER, ctypes.cast(packed, ctypes.c_void_p), BUFFER_SIZE, ctypes.addressof(size), END
        )
        grid = (blocks, 1, 1, threads, 1, 1)
        self._call("cuLaunchKernel", self._function(kernel), *grid, 0, stream, None, extra)

    def _function(self, kernel: str) -> ctypes.c_void_p:
        if kernel not in self._functions:
            function = ctypes.c_void_p()
            self._call("cuModuleGetFunction", ctypes.byref(function), self._handle, kernel.encode())
            self._functions[kernel] = function
        return self._functions[kernel]

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
            message = ctypes.c_char_p()
            self._driver.cuGetErrorString(status, ctypes.byref(message))
            reason = (message.value or b"error").decode()
            if status == OUT_OF_MEMORY:
                raise MemoryError(f"rasterizer=cuda: {name}: {reason}")
            raise UserError(f"rasterizer=cuda: {name}: {reason} ({status}). Try: rasterizer=reference")
