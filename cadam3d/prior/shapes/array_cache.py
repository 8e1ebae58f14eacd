"""A cache, in the user's cache folder, of arrays that take long to compute and depend on the code alone."""

# pyright: reportArgumentType=false

import hashlib
import zipfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch

from cadam3d.core.errors import UserError
from cadam3d.io.atomic import replacing
from cadam3d.io.cache import default_cache_dir

# A dataclass of tensors on the CPU.
Arrays = TypeVar("Arrays")
PACKAGE = Path(__file__).parents[2]


def cached_arrays(kind: type[Arrays], name: str, make: Callable[[], Arrays]) -> Arrays:
    """Return the result of ``make``, from the cache if an earlier process has put it there.

    A file belongs to one state of the sources, one version of torch, one instruction set and one number of
    threads, because all of these may change the last bits. If the folder cannot be written, every process
    calls ``make``.
    """
    path = default_cache_dir() / "shapes" / f"{name}-{_identity()}.npz"
    names = [field.name for field in fields(kind)]
    # The file may not exist yet, or it may be damaged.
    with suppress(OSError, EOFError, ValueError, LookupError, zipfile.BadZipFile), np.load(path) as file:
        return kind(**{name: torch.from_numpy(file[name]) for name in names})
    made = make()
    with suppress(UserError), replacing(path) as temporary:
        np.savez(temporary, **{name: getattr(made, name).numpy() for name in names})
    return made


def _identity() -> str:
    """Return a digest of everything that the arrays depend on."""
    digest = hashlib.sha256()
    for path in sorted([*PACKAGE.glob("core/*.py"), *PACKAGE.glob("prior/shapes/*.py")]):
        digest.update(path.read_bytes())
    facts = (torch.__version__, torch.backends.cpu.get_cpu_capability(), torch.get_num_threads())
    digest.update(repr(facts).encode())
    return digest.hexdigest()[:32]
