"""Find the GPU, the tools and the packages of a machine, with Python alone."""

import ctypes
import hashlib
import os
import shutil
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).parents[2]
DRIVER = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
# Attributes of cuDeviceGetAttribute.
MULTIPROCESSORS, MAJOR, MINOR = 16, 75, 76
# Folders with tools of the CUDA toolkit that are often missing in PATH.
TOOL_FOLDERS = (
    "/usr/local/cuda/bin",
    "/usr/local/cuda/compute-sanitizer",
    "/opt/cuda/bin",
    "/opt/nvidia/nsight-compute/*",
)
TOOLS = ("compute-sanitizer", "ncu", "nvcc", "nvidia-smi", "c++")
# Packages that affect a result by their version, or that are reported if they are missing.
PACKAGES = ("torch", "numpy", "hydra-core", "omegaconf", "pytest", "pytest-xdist", "gsplat", "ninja")
PACKAGES += ("imageio-ffmpeg", "diffusers", "nvidia-cuda-nvrtc")
# Folders and kinds of files that determine the results.
SOURCES = ("cadam3d", "configs", "scripts", "tests/rasterizer")
SUFFIXES = (".py", ".cu", ".cuh", ".cpp", ".h", ".yaml")


class NoGpuError(Exception):
    """There is no usable NVIDIA GPU. The message says what was looked for."""


class TroubleError(Exception):
    """Something that ends the run; the message is one line with what to do."""


@dataclass(frozen=True)
class Device:
    """The first NVIDIA GPU, as its driver describes it."""

    name: str
    capability: str
    memory_bytes: int
    multiprocessors: int
    driver_cuda: str  # the newest CUDA version that the driver supports
    count: int  # of devices that the driver offers


def find_device(load: Callable[[str], Any] = ctypes.CDLL) -> Device:
    """Return the first GPU that the CUDA driver offers. Raises :class:`NoGpuError` if there is none."""
    try:
        driver = load(DRIVER)
    except OSError:
        raise NoGpuError(f"{DRIVER}, the library of the NVIDIA driver, does not load") from None
    count, newest = ctypes.c_int(), ctypes.c_int()
    if status := driver.cuInit(0) or driver.cuDeviceGetCount(ctypes.byref(count)):
        raise NoGpuError(f"{DRIVER} loads, but finds no usable device ({_name_of(driver, status)})")
    if count.value == 0:
        raise NoGpuError(f"{DRIVER} loads, but offers no device")
    driver.cuDriverGetVersion(ctypes.byref(newest))
    name, memory = ctypes.create_string_buffer(256), ctypes.c_size_t()
    driver.cuDeviceGetName(name, len(name), 0)
    driver.cuDeviceTotalMem_v2(ctypes.byref(memory), 0)

    def attribute(number: int) -> int:
        value = ctypes.c_int()
        driver.cuDeviceGetAttribute(ctypes.byref(value), number, 0)
        return value.value

    return Device(
        name=name.value.decode(errors="replace"),
        capability=f"{attribute(MAJOR)}.{attribute(MINOR)}",
        memory_bytes=memory.value,
        multiprocessors=attribute(MULTIPROCESSORS),
        driver_cuda=f"{newest.value // 1000}.{newest.value % 1000 // 10}",
        count=count.value,
    )


def fitting_torch(driver_cuda: str) -> str:
    """Return the requirement of the newest torch of the usual registry that runs with a driver.

    From 2.11 on, it is built for CUDA 13, which no driver for CUDA 12 can run. Raises :class:`TroubleError`
    if the driver is too old for every torch that the project accepts.
    """
    major = int(driver_cuda.partition(".")[0])
    if major < 12:
        raise TroubleError(
            f"expected a driver for CUDA 12 or newer, got one for CUDA {driver_cuda}. "
            "Try: a machine with driver 525 or newer"
        )
    return "torch" if major >= 13 else "torch<2.11"


def _name_of(driver: Any, status: int) -> str:
    text = ctypes.c_char_p()
    driver.cuGetErrorName(status, ctypes.byref(text))
    return f"{(text.value or b'error').decode()}, {status}"


def find_tools(environment: Mapping[str, str] = os.environ) -> dict[str, str]:
    """Return the paths of those of ``TOOLS`` that are installed."""
    folders = [*environment.get("PATH", "").split(os.pathsep)]
    folders += [
        str(Path(environment[key]) / "bin") for key in ("CUDA_HOME", "CUDA_PATH") if key in environment
    ]
    for pattern in TOOL_FOLDERS:
        folders += sorted(map(str, Path("/").glob(pattern.lstrip("/"))), reverse=True)
    found = {name: shutil.which(name, path=os.pathsep.join(folders)) for name in TOOLS}
    return {name: path for name, path in found.items() if path}


def find_packages() -> dict[str, str]:
    """Return the versions of those of ``PACKAGES`` that are installed."""
    found = {}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def hash_sources(repository: Path = REPOSITORY) -> str:
    """Return a hash of the files that determine the results, also where there is no git."""
    whole = hashlib.sha256()
    for folder in SOURCES:
        for path in sorted((repository / folder).rglob("*")):
            if path.suffix in SUFFIXES:
                whole.update(f"{path.relative_to(repository)}\0".encode() + path.read_bytes())
    return whole.hexdigest()[:16]
