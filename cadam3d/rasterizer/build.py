"""Build the native CPU kernels with a compiler of this machine, and keep them in the user's cache folder.

The name of a cached file contains three hashes: of the sources, flags and machine; of the compiler; and of
the bytes of the file. So a copied home folder, a new release, another compiler or a damaged file each lead to
a fresh build. The hashes do not prove the origin of a file, so the file and its folder must belong to the
user (or to root), and other users must not be able to write them. No lock is needed: every process renames
its finished file into place, and any such file that matches its name is usable.
"""

import ctypes
import hashlib
import os
import platform
import shlex
import shutil
import stat
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from cadam3d.core.errors import UserError
from cadam3d.io.cache import make_private, other_writers
from cadam3d.io.run_folder import spare, typed_path
from cadam3d.rasterizer import base

KERNELS = Path(__file__).parent / "kernels"
SOURCES = ("cpu.cpp", "simd.h", "splat_math.h")
FLAGS = (
    "-std=c++17",
    "-O3",
    "-shared",
    "-fPIC",
    "-pthread",
    "-fvisibility=hidden",
    # Multiplications and additions are fused only where the source calls fma, because the forward and the
    # backward pass must compute the same bits.
    "-ffp-contract=off",
    # Makes sqrt a single instruction; the values stay IEEE.
    "-fno-math-errno",
    "-fno-trapping-math",
    # Code that profits from vectors is written with vectors; automatic vectorization slows down the rest.
    "-fno-tree-vectorize",
    "-Wno-psabi",
)
# The process may already have loaded another, older libstdc++.
STATIC = ("-static-libstdc++", "-static-libgcc")
# Tried in turn until one compiles and runs, because not every compiler knows every flag.
MACHINE_FLAGS = (("-march=native", *STATIC), ("-march=native",), ("-mcpu=native",), ())
CONSTANTS = ("BLUR", "ALPHA_MIN", "ALPHA_MAX", "TRANSMITTANCE_MIN", "NEAR", "FAR", "FRUSTUM_MARGIN")
SUFFIX = ".dll" if sys.platform == "win32" else ".so"
SELF_TEST = "import ctypes, sys; sys.exit(ctypes.CDLL(sys.argv[1]).cadam3d_self_test())"
# Most compilers need three seconds; the first run of `zig c++` needs minutes.
TIMEOUT = 900  # seconds


@dataclass(frozen=True)
class Compiler:
    """A C++ compiler that works."""

    command: tuple[str, ...]
    version: str  # first line of its --version


@dataclass(frozen=True)
class Build:
    """A compiled library, ready to load."""

    path: Path
    seconds: float  # time spent compiling; 0 for a library from the cache


def find_compiler() -> Compiler | None:
    """Return the first that works of ``$CXX``, ``c++``, ``g++``, ``clang++`` and Python's ``ziglang``."""
    commands = [tuple(os.environ.get("CXX", "").split()), ("c++",), ("g++",), ("clang++",)]
    if find_spec("ziglang"):
        commands.append((sys.executable, "-P", "-m", "ziglang", "c++"))
    for command in commands:
        if command and shutil.which(command[0]):
            answer = _run([*command, "--version"])
            if answer.returncode == 0 and answer.stdout.strip():
                return Compiler(command, answer.stdout.splitlines()[0].strip())
    return None


def find_cached(cache_dir: Path, compiler: Compiler | None) -> Path | None:
    """Return an intact library for these sources and this machine, or ``None`` if there is none.

    Only libraries built by ``compiler`` count, or by any compiler if that is ``None``.
    """
    by = short_hash(compiler.version) if compiler else "*"
    return find_intact(cache_dir, f"rasterizer-{_key()}-{by}-*{SUFFIX}")


def build(cache_dir: Path, machine_flags: Sequence[Sequence[str]] = MACHINE_FLAGS) -> Build:
    """Return the library in ``cache_dir``, and compile it if it is missing.

    ``machine_flags`` are alternatives, tried in turn. Raises :class:`UserError` if there is neither a cached
    library nor a compiler, if the compiler fails, if the folder cannot be written, or if others can write it.
    """
    cache_dir = own_folder(cache_dir, "cpu")
    compiler = find_compiler()
    cached = find_cached(cache_dir, compiler) if tuple(machine_flags) == MACHINE_FLAGS else None
    if cached:
        return Build(cached, 0.0)
    if compiler is None:
        raise UserError(
            "rasterizer=cpu: expected a C++ compiler ($CXX, c++, g++ or clang++) to build the kernels once, "
            "got none. `apt install g++` or `xcode-select --install` installs one, and so does pip. "
            "Try: pip install 'cadam3d[compiler]'"
        )
    start = time.perf_counter()
    with build_folder(cache_dir, "cpu") as folder:
        path = _compile(compiler, folder / f"rasterizer{SUFFIX}", machine_flags)
        by, digest = short_hash(compiler.version), short_hash(path.read_bytes())
        final = cache_dir / f"rasterizer-{_key()}-{by}-{digest}{SUFFIX}"
        keep(path, final)
    return Build(final, time.perf_counter() - start)


def own_folder(cache_dir: Path, name: str) -> Path:
    """Return ``cache_dir`` without links. It may not exist yet.

    Raises :class:`UserError` if another user may have put files for rasterizer=``name`` there.
    """
    folder = typed_path(str(cache_dir))
    try:
        reason = other_writers(folder)
    except FileNotFoundError:
        reason = ""
    except OSError as error:
        reason = error.strerror or str(error)
    if reason:
        raise UserError(
            f"rasterizer={name}: expected a folder for compiled kernels that no other user can write, got "
            f"{folder} ({reason}). Try: {_own_advice(folder, name)}"
        )
    return folder


def _own_advice(folder: Path, name: str) -> str:
    """Return what to type if others can write a folder: take their permission back, or another folder."""
    # Folders that are meant for all users, such as /tmp, have the sticky bit.
    with suppress(OSError):
        facts = folder.stat()
        if facts.st_uid == os.geteuid() and not facts.st_mode & stat.S_ISVTX:
            return f"chmod go-w {shlex.quote(str(folder))}"
    return another_cache(name)


def find_intact(cache_dir: Path, pattern: str) -> Path | None:
    """Return a file of this user with a name like ``pattern`` that ends in the hash of its bytes, or None."""
    for path in sorted(cache_dir.glob(pattern)):
        if path.is_file() and not other_writers(path) and path.stem.endswith(short_hash(path.read_bytes())):
            return path
    return None


def keep(path: Path, final: Path) -> None:
    """Move a finished file to its name in the cache, as one that only this user can write."""
    path.chmod(0o700)
    path.replace(final)


@contextmanager
def build_folder(cache_dir: Path, name: str) -> Iterator[Path]:
    """Yield an empty folder in ``cache_dir`` for files of rasterizer=``name`` that are not finished yet.

    Raises :class:`UserError` if ``cache_dir`` cannot be written.
    """
    try:
        make_private(cache_dir)
        with tempfile.TemporaryDirectory(dir=cache_dir, prefix="build-") as folder:
            yield Path(folder)
    except OSError as error:
        raise UserError(
            f"rasterizer={name}: expected a folder for compiled kernels that can be written, got {cache_dir} "
            f"({error}). Try: {another_cache(name)}"
        ) from error


def another_cache(name: str) -> str:
    """Return the words that make rasterizer=``name`` keep its kernels in a new folder for temporary files.

    They name the rasterizer too, because ``rasterizer=auto`` has no ``cache_dir``.
    """
    folder = spare("cadam3d-kernels")
    return f"rasterizer={name} {shlex.quote(f'rasterizer.cache_dir={folder}')}"


def definitions() -> list[str]:
    """Return the compiler flags that define the constants of the image formation model."""
    return [f"-DSPLAT_{name}={getattr(base, name)!r}" for name in CONSTANTS]


def short_hash(content: str | bytes) -> str:
    """Return 16 hexadecimal digits that identify ``content`` in the name of a cached file."""
    return hashlib.sha256(content.encode() if isinstance(content, str) else content).hexdigest()[:16]


def _compile(compiler: Compiler, target: Path, machine_flags: Sequence[Sequence[str]]) -> Path:
    source = str(KERNELS / SOURCES[0])
    complaint = ""
    for flags in machine_flags:
        answer = _run([*compiler.command, *FLAGS, *flags, *definitions(), source, "-o", str(target)])
        if answer.returncode == 0:
            # The test runs in another process, which an instruction unknown to this machine would end.
            answer = _run([sys.executable, "-I", "-S", "-c", SELF_TEST, str(target)])
            if answer.returncode == 0:
                return target
        complaint = answer.stderr.strip()[-2000:] or f"exit code {answer.returncode}"
    raise UserError(
        f"rasterizer=cpu: {' '.join(compiler.command)} ({compiler.version}) could not build the kernels:\n"
        f"{complaint}\nThe variable $CXX chooses another compiler. Try: rasterizer=reference"
    )


def _run(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return subprocess.CompletedProcess(command, 1, "", str(error))


def _key() -> str:
    parts = [(KERNELS / name).read_text() for name in SOURCES]
    parts += [repr((FLAGS, MACHINE_FLAGS)), repr([getattr(base, name) for name in CONSTANTS])]
    return short_hash("\0".join([*parts, _machine()]))


def _machine() -> str:
    """Return the facts about this machine that ``-march=native`` depends on."""
    facts = [platform.machine(), sysconfig.get_platform(), platform.processor()]
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        wanted = ("model name", "flags", "Features", "CPU part")
        lines = [line for line in cpuinfo.read_text().splitlines() if line.startswith(wanted)]
        # The lines of the cores are the same, or nearly the same.
        facts += sorted(set(lines))
    elif sys.platform == "darwin":
        facts.append(_run(["sysctl", "-n", "machdep.cpu.brand_string"]).stdout)
    return "\n".join(facts)


def load(build: Build) -> ctypes.CDLL:
    """Load the library with ctypes."""
    return ctypes.CDLL(str(build.path))
