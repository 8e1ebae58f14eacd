"""Finding: one line of the report of ``cadam3d doctor``."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from cadam3d.core.errors import UserError


class Verdict(StrEnum):
    """The meaning of a finding for training."""

    OK = "ok"
    NOTE = "note"  # not available, and not needed by default
    BROKEN = "broken"


@dataclass(frozen=True)
class Finding:
    """One line of the report of ``cadam3d doctor``."""

    topic: str
    verdict: Verdict
    found: str
    hint: str = ""  # what to type; empty if nothing is wrong


def attempt(topic: str, check: Callable[[], Finding], *, is_needed: bool = False) -> Finding:
    """Return the finding of ``check``, or one about the error that it raises.

    The error is a note if something is not available that training does not need.
    """
    try:
        return check()
    except Exception as error:
        is_note = isinstance(error, UserError | ImportError | OSError) and not is_needed
        first, *others = str(error).splitlines() or [type(error).__name__]
        if is_note:
            return Finding(topic, Verdict.NOTE, first, others[-1] if others else "")
        hint = "Try: pip install --upgrade --force-reinstall ."
        return Finding(topic, Verdict.BROKEN, f"{type(error).__name__}: {first}", hint)
