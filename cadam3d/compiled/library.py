"""Build native libraries with a C++ compiler of this machine, and keep them in the user's cache folder.

The name of a cached file contains three hashes: of the sources, flags and machine; of the compiler; and of
the bytes of the file. So a copied home folder, a new release, another compiler or a damaged file each lead to
a fresh build. The hashes do not prove the origin of a file, so the file and its folder must belong to the
user (or to root), and other users must not be able to write them. No lock is needed: every process renames
its finished file into place, and any such file that matches its name is usable.
"""

import hashlib
import os
import platform
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from cadam3d.core.errors import UserError
from cadam3d.io.cache import make_private, other_writers
from cadam3d.io.run_folder import typed_path

# A header that libraries may include: vectors of the width of this machine.
SIMD = Path(__file__).parent / "simd.h"
FLAGS = (
    "-std=c++17",
    "-O3",
    "-shared",
    "-fPIC",
    "-pthread",
    "-fvisibility=hidden",
    # Multiplications and additions are fused only where the source calls fma, because some pairs of functions
    # must compute the same bits: a forward and a backward pass, or the same formula here and in torch.
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
SUFFIX = ".dll" if sys.platform == "win32" else ".so"
SELF_TEST = "import ctypes, sys; sys.exit(getattr(ctypes.CDLL(sys.argv[1]), sys.argv[2])())"
# Most compilers need three seconds; the first run of `zig c++` needs minutes.
TIMEOUT = 900  # seconds


@dataclass(frozen=True)
class Names:
    """The names that messages use for something that is compiled, and the words that avoid it."""

    key: str  # the setting that needs it, as in "rasterizer=cpu"
    fallback: str  # what to type to do without it


@dataclass(frozen=True)
class NativeLibrary:
    """A native library: what it is made of, and how it is tested."""

    name: str  # the beginning of the names of its files
    names: Names
    sources: tuple[Path, ...]  # the first is compiled, and it may include the others
    definitions: tuple[str, ...]  # flags such as "-DNAME=1"
    self_test: str  # the function without arguments that returns 0 if the library runs on this machine
    flags: tuple[str, ...] = FLAGS


@dataclass(frozen=True)
class Compiler:
    """A C++ compiler that works."""

    command: tuple[str, ...]
    version: str  # first line of its --version


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


def find_cached(library: NativeLibrary, cache_dir: Path, compiler: Compiler | None) -> Path | None:
    """Return an intact file for these sources and this machine, or ``None`` if there is none.

    Only files built by ``compiler`` count, or by any compiler if that is ``None``.
    """
    by = short_hash(compiler.version) if compiler else "*"
    return find_intact(cache_dir, f"{library.name}-{_key(library)}-{by}-*{SUFFIX}")


def build(
    library: NativeLibrary, cache_dir: Path, machine_flags: Sequence[Sequence[str]] = MACHINE_FLAGS
) -> Path:
    """Return the library in ``cache_dir``, and compile it if it is missing.

    ``machine_flags`` are alternatives, tried in turn. Raises :class:`UserError` if there is neither a cached
    file nor a compiler, if the compiler fails, if the folder cannot be written, or if others can write it.
    """
    cache_dir = own_folder(cache_dir, library.names)
    compiler = find_compiler()
    cached = find_cached(library, cache_dir, compiler) if tuple(machine_flags) == MACHINE_FLAGS else None
    if cached:
        return cached
    if compiler is None:
        raise UserError(
            f"{library.names.key}: expected a C++ compiler ($CXX, c++, g++ or clang++) to build the kernels "
            "once, got none. "
            "Try: pip install '.[compiler]'"
        )
    with build_folder(cache_dir, library.names) as folder:
        path = _compile(library, compiler, folder / f"{library.name}{SUFFIX}", machine_flags)
        by, digest = short_hash(compiler.version), short_hash(path.read_bytes())
        final = cache_dir / f"{library.name}-{_key(library)}-{by}-{digest}{SUFFIX}"
        keep(path, final)
    return final


def own_folder(cache_dir: Path, names: Names) -> Path:
    """Return ``cache_dir`` without links. It may not exist yet.

    Raises :class:`UserError`, in these ``names``, if another user may have put files there.
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
            f"{names.key}: expected a folder for compiled kernels that no other user can write, got "
            f"{folder} ({reason}). Try: {names.fallback}"
        )
    return folder


def find_intact(cache_dir: Path, pattern: str) -> Path | None:
    """Return a file of this user with a name like ``pattern`` that ends in the hash of its bytes, or None."""
    for path in sorted(cache_dir.glob(pattern)):
        # A file of root, from a run with sudo, may be unreadable. A file that is built again replaces it.
        with suppress(OSError):
            if not other_writers(path) and path.stem.endswith(short_hash(path.read_bytes())):
                return path
    return None


def keep(path: Path, final: Path) -> None:
    """Move a finished file to its name in the cache, as one that only this user can write."""
    path.chmod(0o700)
    path.replace(final)


@contextmanager
def build_folder(cache_dir: Path, names: Names) -> Iterator[Path]:
    """Yield an empty folder in ``cache_dir`` for files that are not finished yet.

    Raises :class:`UserError`, in these ``names``, if ``cache_dir`` cannot be written.
    """
    try:
        make_private(cache_dir)
        with tempfile.TemporaryDirectory(dir=cache_dir, prefix="build-") as folder:
            yield Path(folder)
    except OSError as error:
        raise UserError(
            f"{names.key}: expected a folder for compiled kernels that can be written, got {cache_dir} "
            f"({error}). Try: {names.fallback}"
        ) from error


def short_hash(content: str | bytes) -> str:
    """Return 16 hexadecimal digits that identify ``content`` in the name of a cached file."""
    return hashlib.sha256(content.encode() if isinstance(content, str) else content).hexdigest()[:16]


def _compile(
    library: NativeLibrary, compiler: Compiler, target: Path, machine_flags: Sequence[Sequence[str]]
) -> Path:
    folders = dict.fromkeys(f"-I{path.parent}" for path in library.sources)
    complaint = ""
    for flags in machine_flags:
        options = [*library.flags, *flags, *library.definitions, *folders]
        answer = _run([*compiler.command, *options, str(library.sources[0]), "-o", str(target)])
        if answer.returncode == 0:
            # The test runs in another process, which an instruction unknown to this machine would end.
            answer = _run([sys.executable, "-I", "-S", "-c", SELF_TEST, str(target), library.self_test])
            if answer.returncode == 0:
                return target
        complaint = answer.stderr.strip()[-2000:] or f"exit code {answer.returncode}"
    raise UserError(
        f"{library.names.key}: {' '.join(compiler.command)} ({compiler.version}) could not build the "
        f"kernels:\n{complaint}\nThe variable $CXX chooses another compiler. Try: {library.names.fallback}"
    )


def _run(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
    try:
        # A compiler may write in another encoding than this process.
        return subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=TIMEOUT, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return subprocess.CompletedProcess(command, 1, "", str(error))


def _key(library: NativeLibrary) -> str:
    parts = [path.read_text() for path in library.sources]
    parts += [repr((library.flags, MACHINE_FLAGS)), *library.definitions]
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
