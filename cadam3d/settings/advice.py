"""Advice: what Hydra complains about, said as one message that ends with what to type."""

import difflib
import re
import shlex
from collections.abc import Sequence

from hydra.errors import CompactHydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationResolutionError, OmegaConfBaseException

from cadam3d.core.errors import UserError
from cadam3d.settings.compose import compose, config_dir, flatten, quote

SWEEP_COMPLAINT = r"(?:Ambiguous value for argument|Sweep parameters) '(.+?)'(?: requires|$)"
NO_NAME_COMPLAINT = "Config group override must be a string or a list"
LAUNCHERS = {  # Hydra's plugins by what they add to hydra/launcher
    "joblib": "hydra-joblib-launcher",
    "submitit_slurm": "hydra-submitit-launcher",
    "submitit_local": "hydra-submitit-launcher",
    "ray": "hydra-ray-launcher",
}
PASTE_PROMPT = 'prompt="a red and yellow checkered torus"'


def did_you_mean(word: str, known: Sequence[str]) -> list[str]:
    """The known words that ``word`` may have been meant to be, the likeliest first; at most three."""
    by_lower = {name.lower(): name for name in known}
    matches = difflib.get_close_matches(word.lower(), list(by_lower), n=3, cutoff=0.6)
    return [by_lower[match] for match in matches]


def explain(error: Exception, config_name: str, overrides: Sequence[str]) -> UserError | None:
    """The message for an exception of Hydra or OmegaConf while composing; None for any other exception."""
    if isinstance(error, MissingConfigException):
        return _unknown_option(error, config_name, overrides)
    if isinstance(error, OverrideParseException):
        return _unreadable(error.override, str(error).splitlines()[0])
    if isinstance(error, ValueError) and str(error).startswith(NO_NAME_COMPLAINT):
        return _no_name(str(error), overrides)
    if isinstance(error, InterpolationResolutionError):
        reason = str(error).splitlines()[0]
        key = error.full_key or "a setting"
        return UserError(
            f"{key}: {reason}. Try: a plain value; cadam3d {config_name} --cfg job lists the keys"
        )
    if isinstance(error, (CompactHydraException, OmegaConfBaseException)):
        return _reworded(error, config_name, overrides)
    return None


def missing_values(cfg: DictConfig) -> list[str]:
    """The dotted keys that still say ``???``, apart from Hydra's own."""
    raw = OmegaConf.to_container(cfg, resolve=False)
    return [key for key, value in flatten(raw) if value == "???" and not key.startswith("hydra.")]


def ask_for(keys: Sequence[str], config_name: str) -> UserError:
    """The message for values that the user must give."""
    first = keys[0]
    example = PASTE_PROMPT if first == "prompt" else f"{first}=..."
    grid = " grid=thresholds" if config_name == "sweep" else ""
    return UserError(f"{', '.join(keys)}: no value given. Try: cadam3d {config_name} {example}{grid}")


def _reworded(error: Exception, config_name: str, overrides: Sequence[str]) -> UserError:
    """A complaint that only its text tells from others."""
    text = str(error).strip() or str(error.__cause__ or "")
    if key := re.search(r"Could not override '([^']+)'", text):
        return _unknown_key(key.group(1), config_name, overrides)
    if sweep := re.search(SWEEP_COMPLAINT, text, re.M):
        return _several_values(sweep.group(1))
    cause = error.__cause__
    detail = f" ({str(cause).splitlines()[0]})" if isinstance(cause, OmegaConfBaseException) else ""
    return UserError(f"{' '.join(text.split())}{detail}")


def _unknown_option(error: MissingConfigException, config_name: str, overrides: Sequence[str]) -> UserError:
    """A group exists but not the chosen option of it, or the command itself has no YAML."""
    path = error.missing_cfg_file or ""
    group, _, option = path.rpartition("/")
    if group == "hydra/launcher" and option in LAUNCHERS:
        package = LAUNCHERS[option]
        return UserError(f"launcher: {package} is not installed. Try: pip install {package}")
    options = sorted(error.options or (file.stem for file in (config_dir() / group).glob("*.yaml")))
    if not group or not options:
        return UserError(f"{path}: no such configuration in {config_dir()}. Try: cadam3d doctor")
    best = (did_you_mean(option, options) or options)[0]
    return UserError(f"{group}: expected one of {'|'.join(options)}, got {option!r}. Try: {group}={best}")


def _no_name(reason: str, overrides: Sequence[str]) -> UserError:
    """A group was given null, a number or a dict where the name of an option belongs."""
    for line in overrides:
        key, _, value = line.lstrip("+").partition("=")
        options = sorted(file.stem for file in (config_dir() / key).glob("*.yaml")) if key else []
        if options and value not in options and not value.startswith("["):
            best = "none" if "none" in options else options[0]
            return UserError(f"{key}: expected one of {'|'.join(options)}, got {value}. Try: {key}={best}")
    return UserError(f"{reason}. Try: the name of an option instead of null")


def _unknown_key(key: str, config_name: str, overrides: Sequence[str]) -> UserError:
    """A key that the configuration does not have: look for it in another spelling or another place."""
    if key == "grid" and config_name == "train":
        name = next((line.partition("=")[2] for line in overrides if line.startswith("grid=")), "thresholds")
        return UserError(
            f"grid: grids belong to sweeps. Try: cadam3d sweep {shlex.quote('grid=' + name)} ..."
        )
    value = next((line.split("=", 1)[1] for line in overrides if line.startswith(f"{key}=")), "...")
    if owners := _options_with(key):
        line = f"{owners[0]} {shlex.quote(f'{key}={value}')}"
        return UserError(f"{key}: a setting of {' and '.join(owners)}, not of the chosen option. Try: {line}")
    known = _known_keys(key, config_name, overrides)
    last = key.rpartition(".")[2].lower()
    same_name = [name for name in known if name.rpartition(".")[2].lower() == last]
    suggestions = same_name or did_you_mean(key, known)
    if not suggestions:
        return UserError(
            f"{key}: no such setting. Try: cadam3d {config_name} --cfg job (it lists all of them)"
        )
    meant = " or ".join(suggestions[:3])
    return UserError(
        f"{key}: no such setting. Did you mean {meant}? Try: {shlex.quote(f'{suggestions[0]}={value}')}"
    )


def _options_with(key: str) -> list[str]:
    """Return the options (such as ``densifier=cadam_open``) of the group of ``key`` that have its setting.

    Left out are options that build on another one, and those that need a value from the user.
    """
    group, _, name = key.partition(".")
    owners = []
    for file in sorted((config_dir() / group).glob("*.yaml")):
        content = OmegaConf.to_container(OmegaConf.load(file), resolve=False)
        if isinstance(content, dict) and "_target_" in content and name in content:
            is_alone = not file.read_text(encoding="utf-8").startswith("# @package")
            if is_alone and "???" not in content.values():
                owners.append(f"{group}={file.stem}")
    return owners


def _known_keys(wrong: str, config_name: str, overrides: Sequence[str]) -> list[str]:
    """Every key of the configuration, with the groups that the user chose if those compose."""
    choices = [line for line in overrides if re.match(r"[a-z]\w*=[\[\]\w,]+$", line) and "." not in line]
    choices = [line for line in choices if not line.startswith(f"{wrong}=")]
    for attempt in (choices, []):
        try:
            cfg = compose(attempt, config_name)
        except (CompactHydraException, OmegaConfBaseException):
            continue
        keys = [key for key, _ in flatten(OmegaConf.to_container(cfg, resolve=False), with_nodes=True)]
        return [key for key in keys if not key.rpartition(".")[2].startswith("_")]
    return []


def _unreadable(override: str, reason: str) -> UserError:
    key, _, value = override.partition("=")
    line = f"{key}={quote(value)}"
    typed = shlex.quote(line) if re.search(r'["$`\\!]', line) else f'"{line}"'
    return UserError(f"{key}: cannot read the value ({reason}). Try: {typed}")


def _several_values(override: str) -> UserError:
    key, _, value = override.partition("=")
    return UserError(
        f"{key}: several values make a sweep. Try: cadam3d sweep {shlex.quote(override)} ... "
        f"(a list is {shlex.quote(f'{key}=[{value}]')})"
    )
