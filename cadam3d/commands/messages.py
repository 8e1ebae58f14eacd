"""Notes: messages that are neither results nor errors."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

from cadam3d.core.console import say
from cadam3d.core.errors import UserError
from cadam3d.core.memory import is_out_of_memory
from cadam3d.rasterizer.base import Backend

log = logging.getLogger(__name__)


@contextmanager
def keeping_others(name: str, warnings: list[str], *, is_only: bool = False) -> Iterator[None]:
    """Turn the failure of one output into a warning, so that it costs no other output.

    ``name`` is its key, such as ``exporter.turntable``. Only ``UserError`` and running out of memory are
    failures of this kind; other exceptions are raised. If it is the only output that the command makes
    (``is_only``), its failure is a ``UserError``.
    """
    try:
        yield
    except Exception as error:
        if is_out_of_memory(error):
            text = f"{name}: not enough memory. Try: smaller settings of {name}"
        elif isinstance(error, UserError):
            text = str(error) if str(error).startswith(name) else f"{name}: {error}"
        else:
            raise
        if is_only:
            raise UserError(text) from error
        warn(text, warnings)


def warn(text: str, warnings: list[str]) -> None:
    """Print a warning, and add it to the run's warnings."""
    warnings.append(text)
    log.info("%s", text)
    say(f"Warning: {text}", logging.WARNING)


@cache
def note(text: str) -> None:
    """Print ``text`` as a note, once per process."""
    say(f"Note: {text}", logging.WARNING)


def note_backend(backend: Backend) -> None:
    """Print a note if another backend renders because a faster one is not available."""
    if backend.reason:
        note(f"rendering with rasterizer={backend.name}: {backend.reason}")
