"""One line of what ``cadam3d doctor`` reports."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from cadam3d.core.errors import UserError


class Verdict(StrEnum):
    """What a finding means for training."""

    OK = "ok"
    NOTE = "note"  # absent, and not needed by default
    BROKEN = "broken"


@dataclass(frozen=True)
class Finding:
    """One line of the report."""

    topic: str
    verdict: Verdict
    found: str
    hint: str = ""  # what to type, unless all is well
    facts: Mapping[str, object] = field(default_factory=dict)  # the same for programs, in JSON's types


def attempt(topic: str, check: Callable[[], Finding]) -> Finding:
    """What ``check`` finds. What is not available here is a note, and says why; any other error is a bug."""
    try:
        return check()
    except (UserError, ImportError, OSError) as error:
        first, *others = str(error).splitlines() or [type(error).__name__]
        return Finding(topic, Verdict.NOTE, first, others[-1] if others else "")
    except Exception as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        return Finding(topic, Verdict.BROKEN, reason, "Try: pip install --force-reinstall cadam3d")
