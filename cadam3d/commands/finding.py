"""Finding: one line of the report of ``cadam3d doctor``."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
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
    facts: Mapping[str, object] = field(default_factory=dict)  # JSON values, for programs


def attempt(topic: str, check: Callable[[], Finding]) -> Finding:
    """Return the finding of ``check``: a note if something is not available, broken after any other error."""
    try:
        return check()
    except (UserError, ImportError, OSError) as error:
        first, *others = str(error).splitlines() or [type(error).__name__]
        return Finding(topic, Verdict.NOTE, first, others[-1] if others else "")
    except Exception as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        return Finding(topic, Verdict.BROKEN, reason, "Try: pip install --force-reinstall cadam3d")
