"""Advice: turn exceptions of Hydra and OmegaConf into one message, with the nearest name that exists."""

import difflib
import errno
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence

import yaml  # comes with OmegaConf
from hydra.errors import CompactHydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationResolutionError, OmegaConfBaseException

from cadam3d.core.errors import UserError
from cadam3d.io.reading import read_yaml
from cadam3d.settings.compose import NO_NAME_COMPLAINT, compose, flatten, quote
from cadam3d.settings.line import key_of
from cadam3d.settings.options import (
    config_dir,
    default_option,
    example_word,
    option_names,
    option_word,
    read_option,
)

SWEEP_COMPLAINT = r"(?:Ambiguous value for argument|Sweep parameters) '(.+?)'(?: requires|$)"
# The package of each option of hydra/launcher that Hydra itself lacks.
LAUNCHERS = {
    "joblib": "hydra-joblib-launcher",
    "submitit_slurm": "hydra-submitit-launcher",
    "submitit_local": "hydra-submitit-launcher",
    "ray": "hydra-ray-launcher",
}
# Paths that a system refuses for their form: they are too long, or links that form a circle.
REFUSED_PATHS = (errno.ENAMETOOLONG, errno.ELOOP)
# The choice of an option or of a list of options.
CHOICE = re.compile(r"\+?[a-z]\w*=(\w+|\[[\w,]*\])")
COMMANDS = ("train", "sweep", "render", "export", "eval", "view", "study", "doctor")


class MissingValuesError(Exception):
    """Required settings have no value."""

    def __init__(self, keys: Sequence[str]) -> None:
        super().__init__(", ".join(keys))
        self.keys = keys


class RefusedJobError(Exception):
    """A job of a sweep cannot be composed. The reason is the ``__cause__`` of this exception."""

    def __init__(self, arm: str, overrides: Sequence[str]) -> None:
        super().__init__(arm)
        self.arm = arm  # "" without a grid
        self.overrides = overrides


def did_you_mean(word: str, known: Sequence[str]) -> list[str]:
    """Return at most three known words that ``word`` may be a misspelling of, the likeliest first."""
    by_lower = {name.lower(): name for name in known}
    matches = difflib.get_close_matches(word.lower(), list(by_lower), n=3, cutoff=0.6)
    return [by_lower[match] for match in matches]


def line_of(command: str, words: Sequence[str]) -> str:
    """Return ``cadam3d <command> <words>`` as it is typed into a shell."""
    return shlex.join(["cadam3d", command, *words])


def require_values(cfg: DictConfig) -> None:
    """Raise ``MissingValuesError`` if keys are still ``???``, apart from Hydra's own."""
    raw = OmegaConf.to_container(cfg, resolve=False)
    keys = [key for key, value in flatten(raw) if value == "???" and not key.startswith("hydra.")]
    if keys:
        raise MissingValuesError(keys)


def reraise_interrupt(error: BaseException) -> None:
    """Raise ``KeyboardInterrupt`` if one caused ``error``; the clean-up of OmegaConf can hide it."""
    seen: BaseException | None = error
    while seen is not None:
        if isinstance(seen, KeyboardInterrupt):
            raise KeyboardInterrupt from error
        seen = seen.__cause__ or seen.__context__


def explain(error: BaseException, command: str, words: Sequence[str]) -> UserError | None:
    """Return the message for an exception that was raised while composing ``cadam3d <command> <words>``.

    Returns None for an exception that is neither one of Hydra or OmegaConf nor about the form of a path,
    because that is a bug.
    """
    reason = error if isinstance(error, UserError) else refused_path(error, words)
    match error:
        case RefusedJobError():
            assert error.__cause__ is not None, "this exception is always raised from another one"
            reason = explain(error.__cause__, command, error.overrides)
            is_of_arm = reason and error.arm and not isinstance(error.__cause__, MissingValuesError)
            reason = UserError(f"arm {error.arm}: {reason}") if is_of_arm else reason
        case MissingValuesError():
            examples = " ".join(example_word(key) or f"{key}=..." for key in error.keys)
            reason = UserError(f"{error}: no value given. Try: {examples}")
        case MissingConfigException():
            reason = _unknown_option(error, command, words)
        case OverrideParseException():
            key, _, value = error.override.partition("=")
            typed = shlex.quote(f"{key}={quote(value)}")
            reason = UserError(f"{key}: cannot read the value ({_first_line(error)}). Try: {typed}")
        case ValueError() if str(error).startswith(NO_NAME_COMPLAINT):
            reason = _no_name(str(error), command, words)
        case InterpolationResolutionError():
            key = error.full_key or "a setting"
            reason = UserError(f"{key}: {_first_line(error)}. Try: cadam3d {command} --cfg job")
        case yaml.YAMLError() | UnicodeDecodeError() | RecursionError():
            text = " ".join(str(error).split())
            reason = UserError(f"configuration: cannot be read ({text}). Try: cadam3d {command} --help")
        case CompactHydraException() | OmegaConfBaseException():
            reason = _reworded(error, command, words)
    return reason


def refused_path(error: BaseException, words: Sequence[str]) -> UserError | None:
    """Explain that the system refuses a path for its form; None for any other exception.

    The program makes no such path by itself, so it is in one of the words.
    """
    if not isinstance(error, OSError) or error.errno not in REFUSED_PATHS:
        return None
    path = str(error.filename)
    values = {word.rpartition("=")[2]: key_of(word) for word in words if word.rpartition("=")[2] in path}
    value = max(values, key=len, default="")
    key = values[value] if values.get(value, value) != value else "path"
    return UserError(f"{key}: expected a path, got {path[:60]!r} ({error.strerror}). Try: a shorter one")


def _first_line(error: BaseException) -> str:
    return str(error).splitlines()[0]


def _reworded(error: Exception, command: str, words: Sequence[str]) -> UserError:
    """Explain an exception of which only the text shows what is wrong."""
    text = str(error).strip() or str(error.__cause__ or "")
    if key := re.search(r"Could not override '([^']+)'", text):
        return _unknown_key(key.group(1), command, words)
    if sweep := re.search(SWEEP_COMPLAINT, text, re.M):
        return _several_values(sweep.group(1), command)
    cause = error.__cause__
    detail = f" ({_first_line(cause)})" if isinstance(cause, OmegaConfBaseException) else ""
    return UserError(f"{' '.join(text.split()).rstrip('.')}{detail}. Try: cadam3d {command} --help")


def _unknown_option(error: MissingConfigException, command: str, words: Sequence[str]) -> UserError:
    """Explain that a group lacks the chosen option, or that the command itself has no YAML."""
    group, _, option = (error.missing_cfg_file or "").rpartition("/")
    if group == "hydra/launcher" and option in LAUNCHERS:
        package = LAUNCHERS[option]
        return UserError(f"launcher: {package} is not installed. Try: pip install {package}")
    options = sorted(error.options or option_names(group))
    if not group or not options:
        return UserError(f"{option}: no such configuration. Try: cadam3d {command} --help")
    near = did_you_mean(option, options)
    example = f"{group}={near[0]}" if near else option_word(group, command)
    # The option can also come from a resumed run or from a YAML file.
    if all(key_of(word) != group for word in words):
        example = "--config-dir=DIR with the folder that has it"
    return UserError(f"{group}: expected one of {'|'.join(options)}, got {option!r}. Try: {example}")


def _no_name(reason: str, command: str, words: Sequence[str]) -> UserError:
    """Explain that a group has null, a number or a dict where it needs the name of an option."""
    for word in words:
        key, _, value = word.lstrip("+").partition("=")
        if (options := option_names(key) if key else []) and value not in options and value[:1] != "[":
            listed = "|".join(options)
            return UserError(
                f"{key}: expected one of {listed}, got {value}. Try: {option_word(key, command)}"
            )
    return UserError(f"{reason}. Try: cadam3d {command} --help")


def _unknown_key(key: str, command: str, words: Sequence[str]) -> UserError:
    """Explain that a key does not exist, and look for it in another spelling, option or command."""
    known = _known(key, command, words)
    if key in known:
        line = f"cadam3d {command} --cfg job"
        return UserError(f"{key}: expected the keys of the present value, got others. Try: {line}")
    value = next((word.partition("=")[2] for word in words if key_of(word) == key), "...")
    if owners := list(_options_with(key))[:3]:
        line = f"{owners[0]} {shlex.quote(f'{key}={value}')}"
        return UserError(f"{key}: a setting of {' and '.join(owners)}, not of the chosen option. Try: {line}")
    root, last = key.partition(".")[0], key.rpartition(".")[2].lower()
    same_name = [name for name in known if name.rpartition(".")[2].lower() == last][:3]
    others = [other for other in COMMANDS if other != command and root in declared_names(other)]
    if others and not same_name:
        line = f"cadam3d {others[0]} --help"
        return UserError(f"{key}: no such setting of {command}, but of {' and '.join(others)}. Try: {line}")
    if near := same_name or did_you_mean(key, list(known))[:1]:
        meant, line = " or ".join(near), shlex.quote(f"{near[0]}={value}")
        return UserError(f"{key}: no such setting. Did you mean {meant}? Try: {line}")
    # A sweep has such a page only for a line with jobs.
    page = "train" if command == "sweep" else command
    return UserError(f"{key}: no such setting. Try: cadam3d {page} --cfg job")


def declared_names(command: str) -> set[str]:
    """Return the settings and groups that the YAML of a command declares, with those that it builds on."""
    page = read_yaml(config_dir() / f"{command}.yaml")
    names = set(page) - {"defaults"}
    for entry in page["defaults"]:
        if isinstance(entry, Mapping):
            names |= set(entry)
        elif entry != "_self_":
            names |= declared_names(entry)
    return names


def _options_with(key: str) -> Iterator[str]:
    """Yield the options, such as ``densifier=cadam_open``, whose values include the setting ``key``."""
    group, _, name = key.partition(".")
    for option in option_names(group) if name else ():
        values = dict(flatten(read_option(group, option).get(group, {})))
        if name in values and "???" not in values.values():
            yield f"{group}={option}"


def _known(wrong: str, command: str, words: Sequence[str]) -> dict[str, object]:
    """Return every key of the configuration with its value.

    The options that the user has chosen are taken into account if they compose.
    """
    choices = [
        word for word in words if CHOICE.fullmatch(word) and key_of(word) not in (wrong, "grid", "prompts")
    ]
    for attempt in (choices, []):
        try:
            cfg = compose(attempt, command)
        except (CompactHydraException, OmegaConfBaseException):
            continue
        keys = flatten(OmegaConf.to_container(cfg, resolve=False), with_nodes=True)
        return {key: value for key, value in keys if not key.rpartition(".")[2].startswith("_")}
    return {}


def _several_values(override: str, command: str) -> UserError:
    """Explain that several values need a sweep, or brackets if they are one list."""
    key, _, value = override.partition("=")
    is_list = isinstance(_known(key, command, []).get(key), list) or isinstance(default_option(key), list)
    if is_list or command not in ("train", "sweep"):
        return UserError(f"{key}: a list has brackets. Try: {shlex.quote(f'{key}=[{value}]')}")
    return UserError(f"{key}: several values make a sweep. Try: {line_of('sweep', [override])}")
