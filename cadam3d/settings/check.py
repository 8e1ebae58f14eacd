"""Check: compare the configuration with the types that the code declares, before anything is built.

A component declares the type of each of its settings, and pydantic compares, so that one check serves all
components, those from elsewhere too. The constructors check the bounds. A setting outside of all components
has the type of its value in the YAML files, and its bounds are here.

On two cores, pydantic needs about 0.1 s to load and 0.03 s for the 150 settings of a run. It is loaded when
the first value is compared, not for a help page.
"""

import inspect
import re
from collections.abc import Mapping, Sequence
from dataclasses import is_dataclass
from functools import cache, partial, reduce
from operator import or_
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from omegaconf import DictConfig, OmegaConf

from cadam3d.core.checks import Check, fail, require_color, whole, within
from cadam3d.core.errors import UserError
from cadam3d.core.schedule import FAR_STEP
from cadam3d.io.reading import is_readable, read_yaml
from cadam3d.settings.compose import flatten
from cadam3d.settings.line import key_of
from cadam3d.settings.options import (
    NOTHING,
    TARGET,
    config_dir,
    declared_names,
    example_word,
    load_class,
    option_word,
    settings_page,
    unknown_setting,
)

REFERENCE = re.compile(r"\$\{([\w.]+)\}")
# The groups of which several options can be chosen.
LISTS = ("regularizer", "exporter", "callback", "metric")
# Larger whole numbers fit into no tensor of int64. The square of any number below this is finite in float32.
LIMIT = 2**63
# The types of settings that are null or missing in the YAML files. The others are texts.
OF_NULL = {
    **dict.fromkeys(("run", "runs", "answers"), str | Sequence[str]),
    **dict.fromkeys(("labels", "arms"), Sequence[str]),
    **dict.fromkeys(("pairs", "job"), int),
}
# The bounds of settings outside of components, also of those that may be null.
BOUNDS: dict[str, Check] = {
    "seed": whole(low=0),
    "steps": whole(low=1, high=FAR_STEP),
    "views": whole(low=1, high=10_000),
    "attempts": whole(low=1, high=1000),
    "port": whole(low=0, high=65535),
    "pairs": whole(low=1),
    "catch_share": within(low=0, high=1),
    "least_caught": within(low=0, high=1),
    # The clips of a study.
    "size": whole(low=1, high=2048),
    "frames": whole(low=1, high=1000),
    "seconds": within(low=0.5, high=60),
    "elevation_deg": within(low=-90, high=90),
    "distance": within(above=0, high=1000),
    "backdrop": partial(require_color),
    "quality": whole(low=1, high=100),
}
WORDS: dict[Any, str] = {
    int: "a whole number",
    float: "a finite number",
    str: "a text",
    bool: "true or false",
    NoneType: "null",
    object: "a component",
    Sequence[int]: "a list of whole numbers",
    Sequence[float]: "a list of numbers",
    Sequence[str]: "a list of texts",
}


def require_effective(cfg: DictConfig, command: str, overrides: Sequence[str]) -> None:
    """Raise an exception unless all settings of a line have values, and every override has an effect.

    It is ``InterpolationResolutionError`` for a setting that refers to something that does not exist, and
    ``UserError`` for settings that have no value, that were removed or that nothing reads. The keys of chosen
    components are checked when these are built.
    """
    raw = OmegaConf.to_container(cfg, resolve=False)
    assert isinstance(raw, dict)
    raw.pop("hydra", None)
    if missing := [key for key, value in flatten(raw) if value == NOTHING]:
        words = [example_word(key) for key in missing]
        given = zip(missing, words, strict=True)
        examples = " ".join(f"{key}=..." if word in ("", f"{key}=null") else word for key, word in given)
        raise UserError(f"{', '.join(missing)}: no value given. Try: {examples}")
    declared = declared_names(command)
    for override in overrides:
        key = key_of(override)
        if key in declared - raw.keys() and (override.startswith("~") or override.endswith("=[]")):
            raise fail(key, expected="a value", got=override, example=example_word(key))
        group, member = [*key.split("."), ""][:2]
        chosen = raw[group] if group in LISTS and isinstance(raw.get(group), dict) else {}
        if isinstance(chosen.get(member), dict) and TARGET not in chosen[member]:
            raise UserError(f"{group}.{member}: is not chosen. Try: '{group}=[{','.join(chosen)}]'")
    # Plain values come first, so that the message names the wrong value and not a setting that refers to it.
    for key in sorted(raw, key=lambda key: isinstance(raw[key], dict)):
        if "${" in str(raw[key]) and OmegaConf.is_config(value := cfg[key]):
            OmegaConf.to_container(value, resolve=True)
    # A setting of the user's own YAML is accepted if another setting refers to it.
    references = " ".join(re.findall(r"\$\{[^}]*", str(raw)))
    for name in map(str, raw):
        if name not in declared and not re.search(rf"\b{re.escape(name)}\b", references):
            raise unknown_setting(name, declared, raw[name], command)


def require_settings(values: Mapping[Any, Any]) -> None:
    """Raise ``UserError`` unless all settings outside of components have values of their types and ranges.

    ``values`` has the value of each setting by its name. A prompt needs something to make.
    """
    for name, declared in _types_of_settings().items():
        if name in values:
            _require(values[name], declared, name)
            if name in BOUNDS and values[name] is not None:
                BOUNDS[name](name, _plain(values[name]))
    if not values.get("prompt", "unused").strip():
        raise fail("prompt", expected="what to make", got=values["prompt"], example=example_word("prompt"))


def require_declared(node: Any, kinds: tuple[type, ...], key: str) -> None:
    """Raise ``UserError`` unless ``node`` describes an object of these classes with values of their types.

    The class in ``_target_`` is loaded but not called. ``key`` is the place of the node, such as ``camera``.
    """
    if not _is_described(node):
        raise fail(key, expected=_in_words(kinds), got=_plain(node), example=option_word(key))
    raw = _plain(node)
    cls = load_class(raw[TARGET], f"{key}.{TARGET}")
    if not issubclass(cls, kinds):
        expected = f"the path of a class ({_in_words(kinds)})"
        raise fail(f"{key}.{TARGET}", expected=expected, got=raw[TARGET], example=option_word(key))
    signature, hints = _signature(cls)
    names = [name for name in map(str, node) if name != TARGET]
    try:
        signature.bind(**dict.fromkeys(names))
    except TypeError as error:
        known = [f"{key}.{name}" for name in signature.parameters]
        for name in names:
            if name not in signature.parameters:
                raise unknown_setting(f"{key}.{name}", known, raw[name]) from error
        raise UserError(f"{key}: {error}. Try: {settings_page('train')}") from error
    for name in names:
        reference = REFERENCE.fullmatch(str(raw[name]))
        # The user changes the node to which a setting refers, such as ${prompting}.
        place = reference.group(1) if reference and OmegaConf.is_config(node[name]) else f"{key}.{name}"
        _require(node[name], hints.get(name, Any), place)


def _require(value: Any, declared: Any, key: str) -> None:
    """Raise ``UserError`` unless ``value`` is of the declared type; the settings of an object are checked."""
    members = get_args(declared) if get_origin(declared) in (Union, UnionType) else (declared,)
    classes = tuple(each for each in members if inspect.isclass(each) and each.__module__ != "builtins")
    if _is_described(value) and classes:
        require_declared(value, classes, key)
        return
    types = [each for each in members if each not in classes]
    plain, expected = _plain(value, resolve=True), _in_words(members)
    is_plain = object in types or not _is_described(value)
    if types and is_plain and _is_of_type(plain, reduce(or_, types)):
        if declared is Any or _is_usable(plain):
            return
        expected += " without control characters" if isinstance(plain, str) else " below 2^63"
    raise fail(key, expected=expected, got=_plain(value), example=example_word(key))


def _is_of_type(value: Any, declared: Any) -> bool:
    """Return whether plain data is of a type. True is no number, and NaN and infinity are none either."""
    from pydantic import ValidationError

    try:
        _adapter(declared).validate_python(value)
    except ValidationError:
        return False
    return True


@cache
def _adapter(declared: Any) -> Any:
    """Return what compares values with a type."""
    from pydantic import ConfigDict, TypeAdapter

    config = ConfigDict(strict=True, allow_inf_nan=False, arbitrary_types_allowed=True)
    return TypeAdapter(declared, config=config)


def _is_usable(value: Any) -> bool:
    """Return whether torch can compute with all numbers in plain data, and a file can hold all its texts."""
    if isinstance(value, dict | list):
        return all(map(_is_usable, [*value, *(value.values() if isinstance(value, dict) else ())]))
    if isinstance(value, str):
        return is_readable(value)
    return not isinstance(value, int | float) or abs(value) < LIMIT


@cache
def _signature(cls: type) -> tuple[inspect.Signature, Mapping[str, Any]]:
    """Return how a class is called, and the types of its parameters."""
    return inspect.signature(cls), get_type_hints(cls if is_dataclass(cls) else cls.__init__)


@cache
def _types_of_settings() -> dict[str, Any]:
    """Return the types of the settings outside of all groups, over all commands."""
    found: dict[str, Any] = {}
    for path in config_dir().glob("*.yaml"):
        for name, value in read_yaml(path).items():
            if name != "defaults" and not isinstance(value, dict):
                declared = _type_of(name, value)
                found[name] = found[name] | declared if name in found else declared
    return dict(sorted(found.items()))


def _type_of(name: str, value: Any) -> Any:
    """Return the type of a setting with this value in the YAML files."""
    if value is None or value == NOTHING:
        declared = OF_NULL.get(name, str)
        return declared | None if value is None else declared
    return Sequence[type(value[0])] if isinstance(value, list) else type(value)


def _is_described(node: Any) -> bool:
    return isinstance(node, DictConfig) and TARGET in node


def _in_words(types: Sequence[Any]) -> str:
    """Return a description of types, such as ``a whole number or null``."""
    words = [
        WORDS.get(each) or (f"an object of class {each.__name__}" if inspect.isclass(each) else str(each))
        for each in types
    ]
    return " or ".join(dict.fromkeys(words))


def _plain(value: Any, *, resolve: bool = False) -> Any:
    return OmegaConf.to_container(value, resolve=resolve) if OmegaConf.is_config(value) else value
