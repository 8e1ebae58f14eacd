"""Checks of settings; their errors name the key, what was expected, what came, and what to type.

A component declares what its fields may be: ``beta1: BelowOne``, or ``cap: Annotated[int, whole(low=1)]``.
"""

import difflib
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import cache, partial
from importlib.util import find_spec
from types import NoneType
from typing import Annotated, Any, TypeGuard, get_args, get_type_hints

from cadam3d.core.errors import UserError

LONGEST_SHOWN = 100  # characters of a wrong value in a message


def fail(key: str, *, expected: str, got: object, example: str = "") -> UserError:
    """Build the error for one configuration key; the caller raises it.

    ``example`` is a whole argument to paste, such as ``"densifier.tau_reset=null"``. Without one, the command
    line suggests the value of the YAML files.
    """
    shown = repr(got)
    shown = shown if len(shown) <= LONGEST_SHOWN else f"{shown[:LONGEST_SHOWN]}... ({len(shown)} characters)"
    message = f"{key}: expected {expected}, got {shown}."
    return UserError(f"{message} Try: {example}") if example else UserError(message, key=key)


def require(claim: bool, key: str, *, expected: str, got: object, example: str = "") -> None:
    """Raise :class:`UserError` unless ``claim`` holds."""
    if not claim:
        raise fail(key, expected=expected, got=got, example=example)


def require_extra(key: str, extra: str, *packages: str) -> None:
    """Raise ``UserError`` unless the packages of an extra are installed, which the setting ``key`` needs."""
    if missing := [name for name in packages if find_spec(name) is None]:
        raise UserError(f"{key}: needs {', '.join(missing)}. Try: pip install '.[{extra}]'")


def require_range(
    key: str,
    value: object,
    *,
    low: float = -math.inf,
    high: float = math.inf,
    below: float = math.inf,
    above: float = -math.inf,
) -> None:
    """Raise unless ``value`` is a finite number in ``[low, high]``, ``< below`` and ``> above``.

    Example: ``require_range("densifier.tau_Q", tau_Q, low=0, below=1)``.
    """
    bounds = [
        f"{sign} {bound:g}"
        for sign, bound in ((">=", low), (">", above), ("<=", high), ("<", below))
        if math.isfinite(bound)
    ]
    number = value if isinstance(value, int | float) and not isinstance(value, bool) else math.nan
    if not (low <= number <= high and above < number < below):
        expected = "a number " + " and ".join(bounds) if bounds else "a finite number"
        raise fail(key, expected=expected, got=value)


def require_whole(key: str, value: object, *, low: float = -math.inf, high: float = math.inf) -> None:
    """Raise unless ``value`` is an ``int`` in ``[low, high]``; 2.0 and ``True`` are refused.

    Example: ``require_whole("refine.interval", interval, low=1)``.
    """
    if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
        bounds = [f"{sign} {bound}" for sign, bound in ((">=", low), ("<=", high)) if math.isfinite(bound)]
        expected = " ".join(["a whole number", " and ".join(bounds)]).rstrip()
        raise fail(key, expected=expected, got=value)


def unless_none(check: Callable[..., None], key: str, value: object, **bounds: object) -> None:
    """Call ``check(key, value, **bounds)``, which is one of the functions here, unless ``value`` is None."""
    if value is not None:
        check(key, value, **bounds)


def require_choice(key: str, value: object, choices: Collection[object]) -> None:
    """Raise unless ``value`` is one of ``choices``, of the same type.

    The message lists the choices. It suggests the nearest one, or the first one if none is near.
    """
    # The types are compared too, because True == 1 == 1.0.
    if not any(type(value) is type(choice) and value == choice for choice in choices):
        known = [str(choice).lower() if isinstance(choice, bool) else str(choice) for choice in choices]
        example = f"{key}={nearest(value, known) or known[0]}"
        raise fail(key, expected=f"one of {'|'.join(known)}", got=value, example=example)


def nearest(word: object, known: Iterable[str], *, least: float = 0.6) -> str:
    """Return the known word that ``word`` is probably a misspelling of, in upper or lower case; "" if none.

    ``least`` is the smallest similarity in [0, 1], where 1 stands for equal words.
    """
    by_lower = {name.lower(): name for name in known}
    near = difflib.get_close_matches(str(word).lower(), list(by_lower), n=1, cutoff=least)
    return by_lower[near[0]] if near else ""


def require_color(key: str, value: object, *, otherwise: str = "") -> None:
    """Raise unless ``value`` is an RGB colour, three numbers in [0, 1], or the word ``otherwise``."""
    is_color = are_numbers(value, low=0, high=1) and len(value) == 3
    expected = f"three numbers in [0, 1] or {otherwise}" if otherwise else "three numbers in [0, 1]"
    require(is_color or (bool(otherwise) and value == otherwise), key, expected=expected, got=value)


def are_numbers(value: object, *, low: float, high: float) -> TypeGuard[Sequence[float]]:
    """Return whether ``value`` is a sequence of numbers in ``[low, high]``, without text or truth values."""
    return isinstance(value, Sequence) and all(
        isinstance(item, int | float) and not isinstance(item, bool) and low <= item <= high for item in value
    )


Check = partial[None]  # of a function that raises UserError for a key and its value


def within(**bounds: float) -> Check:
    """Return the check of a number, with the bounds of :func:`require_range`."""
    return partial(require_range, **bounds)


def whole(**bounds: float) -> Check:
    """Return the check of a whole number, with the bounds of :func:`require_whole`."""
    return partial(require_whole, **bounds)


def one_of(choices: Collection[object]) -> Check:
    """Return the check that a value is one of ``choices``."""
    return partial(require_choice, choices=choices)


def each(check: Check) -> Check:
    """Return the check of a sequence, of which every item passes ``check``."""
    return partial(require_each, check=check)


def require_each(key: str, values: Iterable[object], check: Check) -> None:
    """Raise ``UserError`` unless every value passes ``check``."""
    for value in values:
        check(key, value)


Positive = Annotated[float, within(above=0)]
AtLeastZero = Annotated[float, within(low=0)]
Share = Annotated[float, within(low=0, high=1)]
BelowOne = Annotated[float, within(low=0, below=1)]
Elevation = Annotated[float, within(low=-90, high=90)]  # degrees
Count = Annotated[int, whole(low=1)]
Whole = Annotated[int, whole(low=0)]
Color = Annotated[Sequence[float], partial(require_color)]  # RGB in [0, 1]


class Declared:
    """Base of components, dataclasses whose annotations declare what their fields may be.

    What holds for a number holds for the values of a schedule too. A field may be None if its type has None.
    """

    def __post_init__(self) -> None:
        """Raise ``UserError`` for a field that is not what its annotation declares.

        The message names the class. The component that is built from a configuration has a place in it.
        """
        for name, (checks, is_optional) in declared(type(self)).items():
            value = getattr(self, name)
            values = () if value is None and is_optional else getattr(value, "extremes", (value,))
            for check in checks:
                for each in values:
                    check(f"{type(self).__name__}.{name}", each)

    def expect(self, claim: bool, name: str, expected: str, example: object = "") -> None:
        """Raise ``UserError`` about the field ``name`` unless ``claim`` holds; try ``example``."""
        key = f"{type(self).__name__}.{name}"
        line = f"{key}={example}" if example != "" else ""
        require(claim, key, expected=expected, got=getattr(self, name), example=line)


@cache
def declared(cls: type) -> dict[str, tuple[tuple[Check, ...], bool]]:
    """Return the checks of each annotated field of a class, and whether the field may be None."""
    found: dict[str, tuple[tuple[Check, ...], bool]] = {}
    for name, hint in get_type_hints(cls, include_extras=True).items():
        parts = list(_parts(hint))
        if checks := tuple(part for part in parts if isinstance(part, partial)):
            found[name] = checks, NoneType in parts
    return found


def _parts(hint: Any) -> Iterator[Any]:
    """Yield the types and the metadata inside a type, at any depth."""
    yield hint
    for part in (*get_args(hint), *getattr(hint, "__metadata__", ())):
        yield from _parts(part)
