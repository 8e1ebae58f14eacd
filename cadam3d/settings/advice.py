"""Advice: turn exceptions of Hydra and OmegaConf into one message, with the nearest name that exists."""

import errno
import re
import shlex
from collections.abc import Mapping, Sequence

import yaml  # comes with OmegaConf
from hydra.errors import CompactHydraException, MissingConfigException, OverrideParseException
from omegaconf import OmegaConf
from omegaconf.errors import InterpolationResolutionError, OmegaConfBaseException

from cadam3d.core.checks import nearest
from cadam3d.core.errors import UserError
from cadam3d.settings.compose import NO_NAME_COMPLAINT, compose, flatten, quote
from cadam3d.settings.line import key_of
from cadam3d.settings.options import default_option, example_word, option_names, option_word, read_option

SWEEP_COMPLAINT = r"(?:Ambiguous value for argument|Sweep parameters) '(.+?)'(?: requires|$)"
# The choice of an option or of a list of options.
CHOICE = re.compile(r"\+?[a-z]\w*=(\w+|\[[\w,]*\])")


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


def line_of(command: str, words: Sequence[str]) -> str:
    """Return ``cadam3d <command> <words>`` as it is typed into a shell."""
    return shlex.join(["cadam3d", command, *words])


def settings_page(command: str) -> str:
    """Return the line that prints the settings of a command. A sweep has those of training."""
    return f"cadam3d {'train' if command == 'sweep' else command} --cfg job"


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
    reason = error if isinstance(error, UserError) else refused_path(error)
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
            reason = _unknown_option(error, command)
        case OverrideParseException():
            key, _, value = error.override.partition("=")
            typed = shlex.quote(f"{key}={quote(value)}")
            reason = UserError(f"{key}: cannot read the value ({_first_line(error)}). Try: {typed}")
        case ValueError() if str(error).startswith(NO_NAME_COMPLAINT):
            reason = _no_name(str(error), command, words)
        case InterpolationResolutionError():
            key = error.full_key or "a setting"
            reason = UserError(f"{key}: {_first_line(error)}. Try: {settings_page(command)}")
        case yaml.YAMLError() | UnicodeDecodeError() | RecursionError():
            text = " ".join(str(error).split())
            reason = UserError(f"configuration: cannot be read ({text}). Try: cadam3d {command} --help")
        case CompactHydraException() | OmegaConfBaseException():
            reason = _reworded(error, command, words)
    return reason


def refused_path(error: BaseException) -> UserError | None:
    """Explain that a path is too long or a link to itself; None for any other exception."""
    if isinstance(error, OSError) and error.errno in (errno.ENAMETOOLONG, errno.ELOOP):
        got = str(error.filename)[:60]
        return UserError(f"path: expected a path, got {got!r} ({error.strerror}). Try: a shorter one")
    return None


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


def _unknown_option(error: MissingConfigException, command: str) -> UserError:
    """Explain that a group lacks the chosen option, or that the command itself has no YAML."""
    group, _, option = (error.missing_cfg_file or "").rpartition("/")
    if group == "hydra/launcher":
        package = f"hydra-{option.partition('_')[0]}-launcher"
        return UserError(f"launcher: {option} is not installed. Try: pip install {package}")
    options = sorted(error.options or option_names(group))
    if not group or not options:
        return UserError(f"{option}: no such configuration. Try: cadam3d {command} --help")
    near = nearest(option, options)
    example = f"{group}={near}" if near else option_word(group, command)
    return UserError(f"{group}: expected one of {'|'.join(options)}, got {option!r}. Try: {example}")


def _no_name(reason: str, command: str, words: Sequence[str]) -> UserError:
    """Explain that a group has null, a number or a dict where it needs the name of an option."""
    for word in words:
        key, _, value = word.lstrip("+").partition("=")
        if (options := option_names(key) if key else []) and value not in options and value[:1] != "[":
            expected, example = "|".join(options), option_word(key, command)
            return UserError(f"{key}: expected one of {expected}, got {value}. Try: {example}")
    return UserError(f"{reason}. Try: cadam3d {command} --help")


def _unknown_key(key: str, command: str, words: Sequence[str]) -> UserError:
    """Explain that a key does not exist, with the nearest one, or with an option that has it."""
    value = next((word.partition("=")[2] for word in words if key_of(word) == key), "...")
    if owner := _option_with(key):
        line = f"{owner} {shlex.quote(f'{key}={value}')}"
        return UserError(f"{key}: a setting of {owner}, not of the chosen option. Try: {line}")
    known = _known(key, command, words)
    by_last = {name.rpartition(".")[2].lower(): name for name in known}
    near = by_last.get(key.rpartition(".")[2].lower()) or nearest(key, known)
    if not near or near == key:
        return UserError(f"{key}: no such setting. Try: {settings_page(command)}")
    return UserError(f"{key}: no such setting. Did you mean {near}? Try: {shlex.quote(f'{near}={value}')}")


def _option_with(key: str) -> str | None:
    """Return an option, such as ``densifier=cadam_open``, whose values include the setting ``key``."""
    group, _, name = key.partition(".")
    for option in option_names(group) if name else ():
        values = dict(flatten(read_option(group, option).get(group, {})))
        if name in values and "???" not in values.values():
            return f"{group}={option}"
    return None


def _known(wrong: str, command: str, words: Sequence[str]) -> Mapping[str, object]:
    """Return every key of the configuration with its value, for the chosen options if they compose."""
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
