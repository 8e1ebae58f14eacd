"""Errors a user can cause, said so that the next line typed is the right one."""

import math
from collections.abc import Sequence

from cadam3d.core.errors import UserError

__all__ = [
    "UserError",
    "fail",
    "require",
    "require_choice",
    "require_color",
    "require_range",
]


def fail(key: str, *, wanted: str, got: object, example: str) -> UserError:
    """Build the error for one configuration key; the caller raises it.

    ``example`` is a whole argument to paste, such as ``"densifier.tau_Q=0.9"``.
    """
    return UserError(f"{key}: wanted {wanted}, got {got!r}. Try: {example}")


def require(claim: bool, key: str, *, wanted: str, got: object, example: str) -> None:
    """Raise :class:`UserError` unless ``claim`` holds."""
    if not claim:
        raise fail(key, wanted=wanted, got=got, example=example)


def require_range(
    key: str,
    value: object,
    *,
    low: float = -math.inf,
    high: float = math.inf,
    below: float = math.inf,
    above: float = -math.inf,
    example: object,
) -> None:
    """Raise unless ``value`` is a finite number in ``[low, high]``, ``< below`` and ``> above``.

    Example: ``require_range("densifier.tau_Q", tau_Q, low=0, below=1, example=0.9)``.
    """
    bounds = [
        f"{sign} {bound:g}"
        for sign, bound in ((">=", low), (">", above), ("<=", high), ("<", below))
        if math.isfinite(bound)
    ]
    number = value if isinstance(value, int | float) and not isinstance(value, bool) else math.nan
    if not (low <= number <= high and above < number < below):
        wanted = "a number " + " and ".join(bounds) if bounds else "a finite number"
        raise fail(key, wanted=wanted, got=value, example=f"{key}={example}")


def require_choice(key: str, value: object, choices: Sequence[object]) -> None:
    """Raise unless ``value`` is one of ``choices``; the message lists them."""
    if value not in choices:
        listed = "|".join(str(choice) for choice in choices)
        raise fail(key, wanted=f"one of {listed}", got=value, example=f"{key}={choices[0]}")


def require_color(key: str, value: Sequence[float]) -> None:
    """Raise unless ``value`` is an RGB colour: three numbers in [0, 1]."""
    is_color = len(value) == 3 and all(0 <= channel <= 1 for channel in value)
    example = f"'{key}=[0.5,0.5,0.5]'"
    require(is_color, key, wanted="three numbers in [0, 1]", got=list(value), example=example)
