"""Compile the CUDA kernels at run time with the NVRTC of torch's wheels, without nvcc or the CUDA toolkit.

The result is always a cubin for a real architecture, never PTX, because a driver refuses PTX from a newer
compiler. The name of a cached file contains the architecture and two hashes: of the sources, constants,
options and compiler version, and of the file's own bytes. So a new release, another torch or a damaged file
each lead to a fresh build. The file and its folder must belong to the user, as in ``compiled/library.py``. No
lock is needed: every process renames its finished file into place, and any such file that matches its name is
usable.
"""

import ctypes
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import torch

from cadam3d.compiled.library import Names, build_folder, find_intact, keep, own_folder, short_hash
from cadam3d.core.errors import UserError
from cadam3d.rasterizer.base import KERNELS, definitions

NAMES = Names("rasterizer=cuda", fallback="rasterizer=reference")
SOURCE = "cuda.cu"
HEADERS = ("blend.cuh", "device.cuh", "project.cuh", "sort.cuh", "splat_math.h", "tiles.cuh")
OPTIONS = (
    "--std=c++17",
    # Multiplications and additions are fused only where the source calls fma, because the forward and the
    # backward pass must compute the same bits.
    "--fmad=false",
    # Without this, the NVRTC of CUDA 12.8 and 13.0 takes generic lambdas for functions of the host.
    "--device-as-default-execution-space",
)
PATTERN = "*nvrtc64_*.dll" if sys.platform == "win32" else "libnvrtc.so*"
BUILTINS = "*nvrtc-builtins*.dll" if sys.platform == "win32" else "libnvrtc-builtins.so*"
# The name without a number comes last. It belongs to whichever toolkit was installed with its headers, which
# may be too old for the device.
SYSTEM = ("libnvrtc.so.13", "libnvrtc.so.12", "libnvrtc.so")
# Architectures of embedded boards; no other device runs their code.
EMBEDDED = (72, 87, 101)


@dataclass(frozen=True)
class Nvrtc:
    """A loaded NVRTC library."""

    library: ctypes.CDLL
    path: str
    version: tuple[int, int]  # of CUDA
    architectures: tuple[int, ...]  # ascending; 75 is sm_75


@cache
def find_compiler() -> Nvrtc | None:
    """Return the first NVRTC that loads: first from the wheels, then from the system.

    In each of the two groups, the ones of torch's CUDA version come first.
    """
    system = sorted(SYSTEM, key=lambda name: not _fits_torch(name))
    bundled = sorted(
        _bundled(), key=lambda path: (".alt." in path.name, not _fits_torch(path.name), path.name)
    )
    for path in (*bundled, *system):
        try:
            return _load(str(path))
        except OSError:
            continue
    return None


def _bundled() -> Iterator[Path]:
    """Yield the NVRTC libraries of the installed wheels."""
    namespace = find_spec("nvidia")
    folders = [Path(root) for root in (namespace.submodule_search_locations or [])] if namespace else []
    for root in folders:
        for folder in ("lib", "bin", "bin/x86_64"):
            yield from root.glob(f"*/{folder}/{PATTERN}")
    yield from (Path(torch.__file__).parent / "lib").glob(PATTERN)


def _fits_torch(name: str) -> bool:
    # The driver is known to load the CUDA version that torch was built for.
    major = (torch.version.cuda or "").split(".")[0]
    return bool(major) and (name.endswith(f".so.{major}") or f"64_{major}" in name)


def _load(path: str) -> Nvrtc:
    # Some releases search for their built-in functions on the loader's path only, so they are loaded first.
    for builtins in sorted(Path(path).parent.glob(BUILTINS)) if Path(path).is_absolute() else ():
        if ".alt." not in builtins.name:
            ctypes.CDLL(str(builtins), mode=ctypes.RTLD_GLOBAL)
    library = ctypes.CDLL(path)
    library.nvrtcGetErrorString.restype = ctypes.c_char_p
    major, minor, count = ctypes.c_int(), ctypes.c_int(), ctypes.c_int()
    _check(library, library.nvrtcVersion(ctypes.byref(major), ctypes.byref(minor)))
    _check(library, library.nvrtcGetNumSupportedArchs(ctypes.byref(count)))
    architectures = (ctypes.c_int * count.value)()
    _check(library, library.nvrtcGetSupportedArchs(architectures))
    return Nvrtc(library, path, (major.value, minor.value), tuple(sorted(architectures)))


def choose_architecture(capability: tuple[int, int], compiler: Nvrtc) -> int:
    """Return the newest architecture that the compiler supports and that a device of this capability runs.

    Raises :class:`UserError` if there is none.
    """
    major, minor = capability
    device = 10 * major + minor
    fitting = [
        a
        for a in compiler.architectures
        if a // 10 == major and (a == device or (a < device and a not in EMBEDDED))
    ]
    if not fitting:
        version = ".".join(map(str, compiler.version))
        raise UserError(
            f"rasterizer=cuda: the NVRTC of CUDA {version} cannot compile for compute capability "
            f"{major}.{minor}; a torch built for this GPU can. Try: rasterizer=reference"
        )
    return max(fitting)


def build(cache_dir: Path, capability: tuple[int, int]) -> Path:
    """Return the kernels for a compute capability, and compile them if ``cache_dir`` lacks them.

    Raises :class:`UserError` if there is no NVRTC, if it fails, if the folder cannot be written, or if
    others can write it.
    """
    compiler = find_compiler()
    if compiler is None:
        raise UserError(
            "rasterizer=cuda: expected NVRTC, which comes with torch built for CUDA, got none. "
            "Try: pip install nvidia-cuda-nvrtc"
        )
    architecture = choose_architecture(capability, compiler)
    name = f"rasterizer-{_key(compiler)}-sm{architecture}"
    cache_dir = own_folder(cache_dir, NAMES)
    if cached := find_intact(cache_dir, f"{name}-*.cubin"):
        return cached
    code = compile_kernels(compiler, architecture)
    final = cache_dir / f"{name}-{short_hash(code)}.cubin"
    with build_folder(cache_dir, NAMES) as folder:
        path = folder / "rasterizer.cubin"
        path.write_bytes(code)
        keep(path, final)
    return final


def compile_kernels(compiler: Nvrtc, architecture: int, show: Callable[[str], object] | None = None) -> bytes:
    """Return a cubin with all kernels for ``sm_<architecture>``; ``show`` is called with the compiler's log.

    Raises :class:`UserError`, which quotes the log, if the compilation fails.
    """
    library, program = compiler.library, ctypes.c_void_p()
    headers = [(KERNELS / name).read_bytes() for name in HEADERS]
    strings = ctypes.c_char_p * len(HEADERS)
    _check(
        library,
        library.nvrtcCreateProgram(
            ctypes.byref(program),
            (KERNELS / SOURCE).read_bytes(),
            SOURCE.encode(),
            len(HEADERS),
            strings(*headers),
            strings(*(name.encode() for name in HEADERS)),
        ),
    )
    try:
        options = [*OPTIONS, *definitions(), f"--gpu-architecture=sm_{architecture}"]
        array = (ctypes.c_char_p * len(options))(*(option.encode() for option in options))
        status = library.nvrtcCompileProgram(program, len(options), array)
        log = _fetch(compiler, "nvrtcGetProgramLog", program).rstrip(b"\0").decode(errors="replace")
        _check(library, status, log[-2000:])
        if show:
            show(log)
        return _fetch(compiler, "nvrtcGetCUBIN", program)
    finally:
        library.nvrtcDestroyProgram(ctypes.byref(program))


def _fetch(compiler: Nvrtc, what: str, program: ctypes.c_void_p) -> bytes:
    library, size = compiler.library, ctypes.c_size_t()
    _check(library, getattr(library, f"{what}Size")(program, ctypes.byref(size)))
    content = ctypes.create_string_buffer(size.value)
    _check(library, getattr(library, what)(program, content))
    return content.raw


def _check(library: ctypes.CDLL, status: int, log: str = "") -> None:
    if status != 0:
        reason = library.nvrtcGetErrorString(status).decode()
        raise UserError(f"rasterizer=cuda: NVRTC reports {reason}. {log}\nTry: rasterizer=reference")


def _key(compiler: Nvrtc) -> str:
    parts = [(KERNELS / name).read_text() for name in (SOURCE, *HEADERS)]
    return short_hash("\0".join([*parts, *OPTIONS, *definitions(), repr(compiler.version)]))
