"""Declared: compare a node of the configuration with the class that it names, before anything is built.

A component declares the type of each of its settings, so that one check serves all components, those from
elsewhere too. The ranges of the values belong to the constructors.
"""

import difflib
import inspect
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import is_dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import yaml  # comes with OmegaConf
from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf

from cadam3d.core.checks import fail
from cadam3d.core.errors import UserError
from cadam3d.io.run_folder import LATEST
from cadam3d.settings.options import TARGET, argument, example_word, option_word

Kinds = tuple[type, ...]  # a value must be of one of them

# The parser in C is ten times as fast, if PyYAML has it.
LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
# Integers beyond this fit into no tensor.
LARGEST_WHOLE = 2**63 - 1
# Control characters that a text may have.
BLANKS = "\n\t\r"
# The settings outside of all components, over all commands.
SETTINGS: dict[str, Any] = {
    **dict.fromkeys(("prompt", "negative_prompt", "device"), str),
    **dict.fromkeys(("resume", "ply", "ply_up", "output", "select"), str | None),
    "run": str | Sequence[str] | None,
    **dict.fromkeys(("runs", "answers"), str | Sequence[str] | None),
    **dict.fromkeys(("labels", "arms"), Sequence[str] | None),
    **dict.fromkeys(("key", "consent"), str | None),
    **dict.fromkeys(("size", "frames", "quality"), int),
    **dict.fromkeys(("seconds", "elevation_deg", "distance", "catch_share", "least_caught"), float),
    "pairs": int | None,
    "backdrop": Sequence[float],
    **dict.fromkeys(("steps", "views", "seed", "port", "attempts"), int),
    **dict.fromkeys(("open", "json", "same_seed"), bool),
}
EXAMPLES = {"prompt": "a cube", "steps": 600, "run": LATEST, "resume": LATEST, "labels": None}
EXAMPLES |= {"runs": None, "answers": None, "arms": None, "size": 384, "frames": 72, "quality": 80}
EXAMPLES |= {"seconds": 6.0, "elevation_deg": 20.0, "distance": 3.0, "catch_share": 0.1, "least_caught": 0.8}
EXAMPLES |= {"pairs": 30, "backdrop": [1.0, 1.0, 1.0], "same_seed": True, "key": None, "consent": None}
EXAMPLES |= {"negative_prompt": "", "device": "auto", "ply_up": "-y", "views": 2, "seed": 0, "port": 0}
EXAMPLES |= {"attempts": 4, "select": "psnr"}
WORDS = {
    int: "a whole number",
    float: "a finite number",
    str: "a text",
    bool: "true or false",
    NoneType: "null",
}
PLAIN: dict[Any, Callable[[Any], bool]] = {
    int: lambda value: type(value) is int and abs(value) <= LARGEST_WHOLE,
    # NaN and infinity are refused, and so are integers that torch does not read.
    float: lambda value: (
        (type(value) is float and abs(value) <= sys.float_info.max)
        or (type(value) is int and abs(value) <= LARGEST_WHOLE)
    ),
    str: lambda value: isinstance(value, str) and is_readable(value),
    bool: lambda value: isinstance(value, bool),
    NoneType: lambda value: value is None,
}
LISTS, DICTS = (Sequence, list, tuple), (Mapping, dict)
LIMITS = {int: "below 2^63", str: "without control characters"}
# A value of each type, for settings of which no file in this package has one.
SPARE = {int: 1, float: 0.5, str: "text", bool: True, NoneType: None}


def require_settings(values: Mapping[Any, Any]) -> None:
    """Raise ``UserError`` unless all settings outside of components have values of their types.

    ``values`` has the value of each setting by its name. A prompt needs something to make.
    """
    for name in sorted(SETTINGS.keys() & values.keys()):
        if not _fits(values[name], SETTINGS[name], name):
            value = EXAMPLES[name] if name in EXAMPLES else SPARE[_alternatives(SETTINGS[name])[0]]
            raise _refusal(name, SETTINGS[name], values[name], argument(name, value))
    if not values.get("prompt", "unused").strip():
        example = argument("prompt", EXAMPLES["prompt"])
        raise fail("prompt", expected="what to make", got=values["prompt"], example=example)


def require_declared(node: Any, kind: type, key: str) -> None:
    """Raise ``UserError`` unless ``node`` describes an object of class ``kind`` with values of their types.

    The class in ``_target_`` is loaded but not called. ``key`` is the place of the node, such as ``camera``.
    """
    if not _is_described(node):
        raise _refusal(key, kind, _plain(node), option_word(key))
    _require_described(node, (kind,), key)


def _require_described(node: DictConfig, kinds: Kinds, key: str) -> None:
    """Check the class of a node, and the keys and values of its settings."""
    target = _plain(node)[TARGET]
    cls = _loaded(target, kinds, key)
    parameters, hints = _signature(cls)
    names = [name for name in map(str, node) if name != TARGET]
    takes_any = any(each.kind is each.VAR_KEYWORD for each in parameters.values())
    if not takes_any and (unknown := [name for name in names if name not in parameters]):
        raise _unknown(unknown[0], list(parameters), key)
    optional = (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
    missing = [
        name
        for name, each in parameters.items()
        if name not in names and each.default is each.empty and each.kind not in optional
    ]
    if missing:
        listed = ", ".join(missing)
        example = _example(f"+{key}.{missing[0]}", target, cls, missing[0], hints)
        raise UserError(f"{key}: no value for {listed}. Try: {example}")
    for name in names:
        declared, place = hints.get(name, Any), _place(node, name, key)
        value = node[name]
        if not _fits(value, declared, place):
            raise _refusal(place, declared, value, _example(place, target, cls, name, hints))


@cache
def _signature(cls: type) -> tuple[Mapping[str, inspect.Parameter], Mapping[str, Any]]:
    """Return the parameters of a class and their types."""
    hints = get_type_hints(cls if is_dataclass(cls) else cls.__init__)
    return inspect.signature(cls).parameters, hints


def _fits(value: Any, declared: Any, key: str) -> bool:
    """Return whether ``value`` is of the declared type. Raises ``UserError`` for mistakes inside a node."""
    alternatives = _alternatives(declared)
    if Any in alternatives:
        return True
    if _is_described(value):
        kinds = tuple(each for each in alternatives if inspect.isclass(each) and each not in WORDS)
        if kinds:
            _require_described(value, kinds, key)
        return bool(kinds)
    return any(_is_plain(value, each, key) for each in alternatives)


def _is_plain(value: Any, declared: Any, key: str) -> bool:
    """Return whether ``value``, which describes no object, is of one declared type."""
    origin, arguments = get_origin(declared) or declared, get_args(declared)
    if origin in PLAIN:
        return PLAIN[origin](value)
    if origin in LISTS:
        item = arguments[0] if arguments else Any
        return OmegaConf.is_list(value) and all(
            _fits(each, item, f"{key}[{index}]") for index, each in enumerate(value)
        )
    if origin in DICTS:
        return OmegaConf.is_dict(value)
    # A class of components needs a target. Unusual types, such as literals, are left to the constructor.
    return not inspect.isclass(origin)


def _is_described(node: Any) -> bool:
    return isinstance(node, DictConfig) and not node._is_none() and TARGET in node


def is_readable(text: str) -> bool:
    """Return whether a text can be written into a file and shown: Unicode without control characters."""
    return all(
        character in BLANKS or (character >= " " and not "\x7f" <= character <= "\x9f") for character in text
    ) and not any("\ud800" <= character <= "\udfff" for character in text)


def _alternatives(declared: Any) -> tuple[Any, ...]:
    """Return the members of a union, and any other type alone."""
    return get_args(declared) if get_origin(declared) in (Union, UnionType) else (declared,)


def _loaded(target: Any, kinds: Kinds, key: str) -> type:
    """Return the class that ``_target_`` names. Raises ``UserError`` unless it is one of ``kinds``."""
    where, expected = f"{key}.{TARGET}", f"the path of a class ({_in_words(kinds)})"
    if not isinstance(target, str):
        raise UserError(f"{where}: expected {expected}, got {target!r}. Try: {option_word(key)}")
    try:
        found = get_object(target)
    # A module can raise anything while it is imported.
    except Exception as error:
        reason = (str(error.__cause__ or error).splitlines() or [type(error).__name__])[-1]
        raise UserError(f"{where}: cannot be loaded ({reason}). Try: cadam3d doctor") from error
    if not inspect.isclass(found) or not issubclass(found, kinds) or inspect.isabstract(found):
        raise UserError(f"{where}: expected {expected}, got {target!r}. Try: {option_word(key)}")
    return found


def _place(node: DictConfig, name: str, key: str) -> str:
    """Return the key under which a setting is changed: that of the node to which it refers, if it does."""
    child = node._get_node(name)
    if child is not None and child._is_interpolation() and OmegaConf.is_config(node[name]):  # pyright: ignore[reportAttributeAccessIssue]
        return node[name]._get_full_key("")
    return f"{key}.{name}"


def _refusal(key: str, declared: Any, value: Any, example: str) -> UserError:
    alternatives = _alternatives(declared)
    expected = _in_words(alternatives)
    # The type is right, so its limit is what the value exceeds.
    if type(value) in alternatives and type(value) in LIMITS:
        expected = f"{expected} {LIMITS[type(value)]}"
    return UserError(f"{key}: expected {expected}, got {_shown(value)}. Try: {example}")


def _unknown(name: str, known: Sequence[str], key: str) -> UserError:
    near = difflib.get_close_matches(name, known, n=1)
    meant = f" Did you mean {key}.{near[0]}?" if near else ""
    return UserError(f"{key}: there is no key {name}.{meant} Try: cadam3d train --cfg job")


def _in_words(alternatives: Sequence[Any]) -> str:
    """Return a description of types, such as ``a whole number or null``."""
    return " or ".join(dict.fromkeys(_word(each) for each in alternatives))


def _word(declared: Any) -> str:
    if declared in WORDS:
        return WORDS[declared]
    origin, arguments = get_origin(declared), get_args(declared)
    if origin in LISTS:
        items = {int: "whole numbers", float: "numbers", str: "texts"}
        return f"a list of {items.get(arguments[0] if arguments else Any, 'values')}"
    if origin in DICTS:
        return "keys with values"
    if declared is object:
        return "a component"
    return f"an object of class {declared.__name__}" if inspect.isclass(declared) else str(declared)


def _shown(value: Any) -> str:
    text = repr(_plain(value)).encode("utf-8", "backslashreplace").decode("utf-8")
    return text if len(text) <= 100 else f"{text[:100]}... ({len(text)} characters)"


def _plain(value: Any) -> Any:
    return OmegaConf.to_container(value, resolve=False) if OmegaConf.is_config(value) else value


def _example(key: str, target: str, cls: type, name: str, hints: Mapping[str, Any]) -> str:
    """Return an argument with the value that this package gives to a setting, or one of the right type."""
    if word := example_word(key.lstrip("+")):
        return word
    default = inspect.signature(cls).parameters[name].default
    if default is not inspect.Parameter.empty:
        return argument(f"+{key}", default)
    kinds = _alternatives(hints.get(name, float))
    return argument(key, next((SPARE[each] for each in kinds if each in SPARE), [0.5, 0.5]))
