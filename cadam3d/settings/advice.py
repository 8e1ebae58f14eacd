"""Advice: turn exceptions of Hydra and OmegaConf into one message, with the nearest name that exists."""

import re
import shlex
from collections.abc import Sequence
from contextlib import suppress

from hydra.errors import CompactHydraException, MissingConfigException, OverrideParseException
from omegaconf import OmegaConf
from omegaconf.errors import InterpolationResolutionError, OmegaConfBaseException

from cadam3d.core.errors import UserError
from cadam3d.settings.compose import NO_NAME_COMPLAINT, compose, flatten, quote
from cadam3d.settings.line import key_of
from cadam3d.settings.options import (
    default_options,
    option_names,
    settings_page,
    unknown_option,
    unknown_setting,
)

SWEEP_COMPLAINT = r"(?:Ambiguous value for argument|Sweep parameters) '(.+?)'(?: requires|$)"
# The choice of an option or of a list of options.
CHOICE = re.compile(r"\+?[a-z]\w*=(\w+|\[[\w,]*\])")


def explain(error: BaseException, command: str, words: Sequence[str]) -> UserError | None:
    """Return the message for an exception that was raised while composing ``cadam3d <command> <words>``.

    Returns None for an exception that is not one of Hydra or OmegaConf, because that is a bug.
    """
    text = str(error).strip() or str(error.__cause__ or "")
    match error:
        case UserError():
            return error
        case MissingConfigException():
            return _unknown_option(error, command)
        case OverrideParseException():
            key, _, value = error.override.partition("=")
            typed = shlex.quote(f"{key}={quote(value)}")
            reason = text.partition("\n")[0]
            return UserError(f"{key}: cannot read the value ({reason}). Try: {typed}")
        case ValueError() if text.startswith(NO_NAME_COMPLAINT):
            return _no_name(text, command, words)
        case CompactHydraException() | OmegaConfBaseException():
            return _reworded(error, text, command, words)
    return None


def _reworded(error: Exception, text: str, command: str, words: Sequence[str]) -> UserError:
    """Explain an exception of which only the text shows what is wrong."""
    if isinstance(error, InterpolationResolutionError):
        reason = text.partition("\n")[0]
        return UserError(f"{error.full_key or 'a setting'}: {reason}. Try: {settings_page(command)}")
    if found := re.search(r"Could not override '([^']+)'", text):
        typed = [word.partition("=")[2] for word in words if key_of(word) == found[1]]
        return unknown_setting(found[1], _known_keys(found[1], command, words), [*typed, "..."][0], command)
    if sweep := re.search(SWEEP_COMPLAINT, text, re.M):
        key, _, value = sweep[1].partition("=")
        if isinstance(default_options().get(key), list) or command not in ("train", "sweep"):
            return UserError(f"{key}: a list has brackets. Try: {shlex.quote(f'{key}=[{value}]')}")
        return UserError(f"{key}: several values make a sweep. Try: cadam3d sweep {shlex.quote(sweep[1])}")
    cause = error.__cause__
    detail = f" ({str(cause).splitlines()[0]})" if isinstance(cause, OmegaConfBaseException) else ""
    return UserError(f"{' '.join(text.split()).rstrip('.')}{detail}. Try: cadam3d {command} --help")


def _unknown_option(error: MissingConfigException, command: str) -> UserError:
    """Explain that a group lacks the chosen option, or that the command itself has no YAML."""
    group, _, option = (error.missing_cfg_file or "").rpartition("/")
    if group == "hydra/launcher":
        package = f"hydra-{option.partition('_')[0]}-launcher"
        return UserError(f"launcher: {option} is not installed. Try: pip install {package}")
    if group and (options := sorted(error.options or option_names(group))):
        return unknown_option(group, option, options, command)
    return UserError(f"{option}: no such configuration. Try: cadam3d {command} --help")


def _no_name(reason: str, command: str, words: Sequence[str]) -> UserError:
    """Explain that a group has null, a number or a dict where it needs the name of an option."""
    for word in words:
        key, _, value = word.lstrip("+").partition("=")
        if value[:1] != "[" and (options := option_names(key)) and value not in options:
            return unknown_option(key, value, options, command)
    return UserError(f"{reason}. Try: cadam3d {command} --help")


def _known_keys(wrong: str, command: str, words: Sequence[str]) -> list[str]:
    """Return every key of the configuration, for the chosen options if they compose."""
    chosen = [word for word in words if CHOICE.fullmatch(word) and key_of(word) != wrong]
    for choices in (chosen, []):
        with suppress(CompactHydraException, OmegaConfBaseException):
            cfg = OmegaConf.to_container(compose(choices, command), resolve=False)
            keys = [key for key, _ in flatten(cfg, with_nodes=True)]
            return [key for key in keys if not key.rpartition(".")[2].startswith("_")]
    return []
