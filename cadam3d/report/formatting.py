"""How the reports write numbers and other values."""

import math
from datetime import timedelta


def number(value: object) -> float | None:
    """Return ``value`` as a float if it is a finite number, else ``None``. A boolean is not a number."""
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if is_number else None  # pyright: ignore[reportArgumentType]


def show(value: object) -> str:
    """Return any value as text for a page; a dash stands for a missing or infinite one."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, (list, tuple)):
        value = ", ".join(map(str, value))
    if isinstance(value, (int, float)) and math.isfinite(value):
        return f"{value:,.0f}" if abs(value) >= 10_000 else f"{value:.4g}"
    return "-" if value in (None, "") or isinstance(value, float) else str(value)


def short(value: float) -> str:
    """Return a number for an axis: 12300 becomes 12.3k, and 2000000 becomes 2M."""
    for factor, suffix in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= factor:
            return f"{value / factor:.4g}{suffix}"
    return f"{value:.4g}" if abs(value) > 1e-12 else "0"


def elapsed(seconds: float) -> str:
    """Return a time span: seconds with one decimal below a minute, else such as ``1:02:03``."""
    return f"{seconds:.1f} s" if seconds < 60 else str(timedelta(seconds=round(seconds)))
