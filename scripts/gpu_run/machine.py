"""Find the GPU, the tools and the packages of a machine, with Python alone."""

import ctypes
import hashlib
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).parents[2]
DRIVER = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
# Attributes of cuDeviceGetAttribute, and the compute mode in which one process has the GPU for itself.
MAJOR, MINOR, COMPUTE_MODE = 75, 76, 20
EXCLUSIVE_PROCESS = 3
# Folders with tools of the CUDA toolkit that are often missing in PATH.
TOOL_FOLDERS = ("/usr/local/cuda/bin", "/usr/local/cuda/compute-sanitizer", "/opt/cuda/bin")
TOOLS = ("compute-sanitizer", "nvcc", "c++")
# Packages that affect a result by their version, or that are reported if they are missing.
PACKAGES = ("torch", "numpy", "hydra-core", "omegaconf", "pytest", "pytest-xdist", "gsplat", "ninja")
PACKAGES += ("imageio-ffmpeg", "diffusers", "nvidia-cuda-nvrtc")
# Folders and kinds of files that determine the results.
SOURCES = ("cadam3d", "configs", "scripts", "tests/rasterizer")
SUFFIXES = (".py", ".cu", ".cuh", ".cpp", ".h", ".yaml")


class TroubleError(Exception):
    """Something that ends the run; the message is one line with what to do."""


@dataclass(frozen=True)
class Device:
    """The first NVIDIA GPU, as its driver describes it."""

    name: str
    capability: str
    memory_bytes: int
    driver_cuda: str  # the newest CUDA version that the driver supports
    is_exclusive: bool = False  # whether only one process at a time may use it


def find_device(load: Callable[[str], Any] = ctypes.CDLL) -> Device:
    """Return the first GPU that the CUDA driver offers. Raises :class:`TroubleError` if there is none."""
    try:
        driver = load(DRIVER)
    except OSError:
        raise TroubleError(
            f"expected an NVIDIA GPU, got none: {DRIVER} does not load. Try: nvidia-smi"
        ) from None
    count, newest = ctypes.c_int(), ctypes.c_int()
    status = driver.cuInit(0) or driver.cuDeviceGetCount(ctypes.byref(count))
    if status or count.value == 0:
        raise TroubleError(
            f"expected an NVIDIA GPU, got none: {DRIVER} finds no device (error {status}). Try: nvidia-smi"
        )
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
        driver_cuda=f"{newest.value // 1000}.{newest.value % 1000 // 10}",
        is_exclusive=attribute(COMPUTE_MODE) == EXCLUSIVE_PROCESS,
    )


def fitting_torch(driver_cuda: str) -> str:
    """Return the requirement of the newest torch of the usual registry that runs with a driver.

    From 2.11 on, it is built for CUDA 13, which no driver for CUDA 12 can run. Raises :class:`TroubleError`
    if the driver is too old for every torch that the project accepts.
    """
    major = int(driver_cuda.partition(".")[0])
    if major < 12:
        raise TroubleError(f"expected a driver for CUDA 12 or newer (525), got one for CUDA {driver_cuda}")
    return "torch" if major >= 13 else "torch<2.11"


def require_nvcc(torch_cuda: str, nvcc: str | None = None) -> None:
    """Raise :class:`TroubleError` unless nvcc has the major version of CUDA for which torch is built.

    With another one, torch refuses to build an extension such as gsplat, after minutes of preparation.
    """
    nvcc = nvcc or find_tools().get("nvcc", "nvcc")
    said = subprocess.run([nvcc, "--version"], capture_output=True, text=True, check=False).stdout
    release = re.search(r"release (\d+)\.\d+", said)
    major = torch_cuda.partition(".")[0]
    if release is None or release[1] != major:
        got = release[0] if release else f"{nvcc} without a version"
        raise TroubleError(
            f"gsplat is not supported here: expected nvcc {major}, as torch is built for CUDA {torch_cuda}, "
            f"got {got}"
        )


def find_tools() -> dict[str, str]:
    """Return the paths of those of ``TOOLS`` that are installed."""
    path = os.pathsep.join([os.environ.get("PATH", ""), *TOOL_FOLDERS])
    found = {name: shutil.which(name, path=path) for name in TOOLS}
    return {name: tool for name, tool in found.items() if tool}


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
