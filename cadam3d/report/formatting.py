"""How the reports write numbers: counts, bytes, durations and the labels of axes."""

import math

SUFFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"))


def number(value: object) -> float | None:
    """Return ``value`` as a float if it is a finite number, else ``None``. A boolean is not a number."""
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if is_number else None  # pyright: ignore[reportArgumentType]


def show(value: object) -> str:
    """Return any value as text for a page; a dash stands for a missing or infinite one."""
    if value is None or value == "" or (isinstance(value, float) and not math.isfinite(value)):
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}" if abs(value) >= 10_000 else str(value)
    if isinstance(value, float):
        return f"{value:,.0f}" if value.is_integer() and abs(value) < 1e15 else f"{value:.4g}"
    if isinstance(value, (list, tuple)):
        return ", ".join(str(item) for item in value) or "-"
    return str(value)


def short(value: float) -> str:
    """Return a number for an axis or a tooltip: 12300 becomes 12.3k, and 0.00012 becomes 1.2e-4."""
    size = abs(value)
    if size < 1e-12:
        return "0"
    for factor, suffix in SUFFIXES:
        if size >= factor:
            return f"{value / factor:.4g}{suffix}"
    if size < 1e-3:
        mantissa, exponent = f"{value:.2e}".split("e")
        return f"{float(mantissa):g}e{int(exponent)}"
    return f"{value:.4g}"


def shown_bytes(count: float) -> str:
    """Return a number of bytes with a suitable unit."""
    for unit, size in (("GiB", 1 << 30), ("MiB", 1 << 20), ("KiB", 1 << 10)):
        if count >= size:
            return f"{count / size:.1f} {unit}"
    return f"{count:.0f} B"


def elapsed(seconds: float) -> str:
    """Return a time span: seconds with one decimal below a minute, else minutes, else hours and minutes."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s"


def plural(count: int, noun: str) -> str:
    """Return ``1 job`` or ``3 jobs``."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
