"""Advice: turn exceptions of Hydra and OmegaConf into one message that ends with what to type."""

import difflib
import errno
import re
import shlex
from collections.abc import Sequence
from pathlib import Path

import yaml  # comes with OmegaConf
from hydra.errors import CompactHydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationResolutionError, OmegaConfBaseException

from cadam3d.core.errors import UserError
from cadam3d.io.reading import read_yaml
from cadam3d.io.run_folder import CONFIG, HYDRA_SETTINGS, OVERRIDES, suggestion
from cadam3d.settings.compose import NO_NAME_COMPLAINT, compose, flatten, quote
from cadam3d.settings.line import OF_ATTEMPTS, key_of, quoted, text_of
from cadam3d.settings.options import config_dir

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
# The file that the folder named by a setting must have.
NEEDED = {"run": CONFIG, "resume": OVERRIDES}
# The choice of an option or of a list of options.
CHOICE = re.compile(r"\+?[a-z]\w*=(\w+|\[[\w,]*\])")
# The command that has a key, and the reason, by the key and the command that lacks it.
MISPLACED = {
    ("grid", "train"): ("sweep", "grids belong to sweeps"),
    ("prompts", "train"): ("sweep", "files and sets of prompts belong to sweeps"),
    **{("for", command): ("export", "belongs to cadam3d export") for command in ("render", "view")},
}
PROMPT_WORD = 'prompt="a red and yellow checkered torus"'


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


def explain(
    error: BaseException, command: str, words: Sequence[str], settings: Sequence[str] | None = None
) -> UserError | None:
    """Return the message for an exception that was raised while composing ``cadam3d <command> <words>``.

    ``settings`` are the overrides of the job of a sweep that cannot be composed; None means ``words``.
    Returns None for an exception that is neither one of Hydra or OmegaConf nor about the form of a path,
    because that is a bug.
    """
    reason = error if isinstance(error, UserError) else None
    match error:
        case RefusedJobError():
            reason = _job_refused(error, command, words)
        case MissingValuesError():
            reason = _missing_values(error.keys, command, words)
        case MissingConfigException():
            reason = _unknown_option(error, command, words)
        case OverrideParseException():
            reason = _unreadable(error.override, str(error).splitlines()[0])
        case ValueError() if str(error).startswith(NO_NAME_COMPLAINT):
            reason = _no_name(str(error), command, words)
        case InterpolationResolutionError():
            reason = _unresolved(error, command, words)
        case OSError() if is_refused_path(error):
            reason = refused_path(error, command, words)
        case yaml.YAMLError() | UnicodeDecodeError() | RecursionError():
            text = " ".join(str(error).split())
            reason = UserError(f"configuration: cannot be read ({text}). Try: cadam3d {command} --help")
        case CompactHydraException() | OmegaConfBaseException():
            reason = _reworded(error, command, words, settings)
    return reason


def is_refused_path(error: BaseException) -> bool:
    """Return whether the system refuses a path for its form. The program makes no such path by itself."""
    return isinstance(error, OSError) and error.errno in REFUSED_PATHS


def reraise_interrupt(error: BaseException) -> None:
    """Raise ``KeyboardInterrupt`` if one caused ``error``; the clean-up of OmegaConf can hide it."""
    seen: BaseException | None = error
    while seen is not None:
        if isinstance(seen, KeyboardInterrupt):
            raise KeyboardInterrupt from error
        seen = seen.__cause__ or seen.__context__


def require_values(cfg: DictConfig) -> None:
    """Raise ``MissingValuesError`` if keys are still ``???``, apart from Hydra's own."""
    raw = OmegaConf.to_container(cfg, resolve=False)
    keys = [key for key, value in flatten(raw) if value == "???" and not key.startswith("hydra.")]
    if keys:
        raise MissingValuesError(keys)


def line_of(command: str, words: Sequence[str]) -> str:
    """Return ``cadam3d <command> <words>`` as it is typed into a shell."""
    return shlex.join(["cadam3d", command, *words])


def _sweep_line(words: Sequence[str]) -> str:
    """Return a line of ``cadam3d train`` as a sweep, whose jobs are single attempts."""
    return line_of("sweep", [word for word in words if key_of(word) not in OF_ATTEMPTS])


def _job_refused(error: RefusedJobError, command: str, words: Sequence[str]) -> UserError | None:
    """Explain why a job is refused, with its arm. Missing values are reported for the line of the sweep."""
    cause = error.__cause__
    assert cause is not None, "this exception is always raised from another one"
    if isinstance(cause, MissingValuesError):
        return _missing_values(cause.keys, command, words)
    reason = explain(cause, command, words, settings=error.overrides)
    return UserError(f"arm {error.arm}: {reason}") if reason and error.arm else reason


def _missing_values(keys: Sequence[str], command: str, words: Sequence[str]) -> UserError:
    """Explain that required settings have no value, with a line that keeps the rest of what was typed."""
    kept = [shlex.quote(word) for word in words if key_of(word) not in keys]
    added = [PROMPT_WORD if key == "prompt" else f"{key}=..." for key in keys]
    line = " ".join(["cadam3d", command, *kept, *added])
    return UserError(f"{', '.join(keys)}: no value given. Try: {line}")


def refused_path(error: OSError, command: str, words: Sequence[str]) -> UserError | None:
    """Explain that the system refuses a path for its form; None for any other exception."""
    if not is_refused_path(error):
        return None
    path, reason = str(error.filename), error.strerror
    wrong = max(
        (word for word in words if _value(word) in path), key=lambda word: len(_value(word)), default=""
    )
    if not wrong:
        return UserError(f"{path[:60]}: cannot be used ({reason}). Try: cadam3d {command} --help")
    before = words[: list(words).index(wrong)]
    flag = before[-1] if "=" not in wrong and before and before[-1].startswith("--") else ""
    key = flag or key_of(wrong)
    # Without its path, an option such as initializer=ply cannot be used either.
    left_out = {key, key.partition(".")[0]}
    kept = [word for word in words if key_of(word) not in left_out and word not in (wrong, flag)]
    line = line_of(command, kept)
    if key in NEEDED or key == "ply":
        line = suggestion(f"cadam3d {command}", key.replace("ply", "run"), NEEDED.get(key, CONFIG))
    return UserError(f"{key}: expected a path, got {_value(wrong)[:60]!r} ({reason}). Try: {line}")


def _value(word: str) -> str:
    """Return what a word of the command line assigns, or the word if it assigns nothing."""
    return word.partition("=")[2] if "=" in word else word


def _unresolved(error: InterpolationResolutionError, command: str, words: Sequence[str]) -> UserError:
    """Explain that a value refers to a setting that does not exist, with the line without that value."""
    key = error.full_key or "a setting"
    reason = str(error).splitlines()[0]
    kept = [word for word in words if key_of(word) != key]
    line = line_of(command, kept if len(kept) < len(words) else ["--cfg", "job"])
    return UserError(f"{key}: {reason}. Try: {line}")


def _reworded(
    error: Exception, command: str, words: Sequence[str], settings: Sequence[str] | None
) -> UserError:
    """Explain an exception of which only the text shows what is wrong."""
    text = str(error).strip() or str(error.__cause__ or "")
    if key := re.search(r"Could not override '([^']+)'", text):
        return _unknown_key(key.group(1), command, words, settings)
    if sweep := re.search(SWEEP_COMPLAINT, text, re.M):
        return _several_values(sweep.group(1), command, words)
    cause = error.__cause__
    detail = f" ({str(cause).splitlines()[0]})" if isinstance(cause, OmegaConfBaseException) else ""
    return UserError(f"{' '.join(text.split()).rstrip('.')}{detail}. Try: cadam3d {command} --help")


def _unknown_option(error: MissingConfigException, command: str, words: Sequence[str]) -> UserError:
    """Explain that a group lacks the chosen option, or that the command itself has no YAML."""
    path = error.missing_cfg_file or ""
    group, _, option = path.rpartition("/")
    if group == "hydra/launcher" and option in LAUNCHERS:
        package = LAUNCHERS[option]
        return UserError(f"launcher: {package} is not installed. Try: pip install {package}")
    options = sorted(error.options or (file.stem for file in (config_dir() / group).glob("*.yaml")))
    if not group or not options:
        return UserError(f"{path}: no such configuration in {config_dir()}. Try: cadam3d doctor")
    near = did_you_mean(option, options)
    # The other options of a list, or of a sweep, stay.
    typed = next((word.partition("=")[2] for word in words if key_of(word) == group), option)
    best = near[0] if near else default_option(group, command, is_item=typed != option) or options[0]
    if all(key_of(word) != group for word in words) and (run := _resumed_run(words)):
        folder = _config_folder(run) or "DIR"
        return UserError(
            f"{group}: the run in {run} uses {option!r}, an option from a folder that was given with "
            f"--config-dir. Try: {line_of(command, [*words, f'--config-dir={folder}'])}"
        )
    choice = re.sub(rf"\b{re.escape(option)}\b", best.replace("\\", ""), typed)
    example = shlex.quote(f"{group}={choice if choice != typed else best}")
    return UserError(f"{group}: expected one of {'|'.join(options)}, got {option!r}. Try: {example}")


def _resumed_run(words: Sequence[str]) -> Path | None:
    """Return the folder of the run that a line resumes, or None."""
    text = next((text_of(quoted(word, is_sweep=False)) for word in words if key_of(word) == "resume"), "")
    place = Path(text).expanduser()
    return next((folder for folder in (place, *place.parents) if (folder / OVERRIDES).is_file()), None)


def _config_folder(run: Path) -> str | None:
    """Return the folder that --config-dir named when a run was started, if its files say so.

    The files may be a stranger's. The folder appears only in a message, which the user judges.
    """
    try:
        sources = read_yaml(run / HYDRA_SETTINGS)["hydra"]["runtime"]["config_sources"]
        paths = [source["path"] for source in sources if source["provider"] == "command-line"]
        text = str(paths[0])
        return text if text.isprintable() and Path(text).is_dir() else None
    except (UserError, LookupError, TypeError, ValueError, OSError):
        return None


def _no_name(reason: str, command: str, words: Sequence[str]) -> UserError:
    """Explain that a group has null, a number or a dict where it needs the name of an option."""
    for word in words:
        key, _, value = word.lstrip("+").partition("=")
        options = sorted(file.stem for file in (config_dir() / key).glob("*.yaml")) if key else []
        if options and value not in options and not value.startswith("["):
            best = "none" if "none" in options else default_option(key, command)
            # Without a default, such as that of experiment, leaving the word out is what null means.
            rest = [other for other in words if other != word]
            line = shlex.quote(f"{key}={best}") if best else line_of(command, rest)
            return UserError(f"{key}: expected one of {'|'.join(options)}, got {value}. Try: {line}")
    return UserError(f"{reason}. Try: cadam3d {command} --help")


def default_option(group: str, command: str, *, is_item: bool = False) -> str | None:
    """Return the option of a group that ``command`` uses by default, as it is typed.

    This may be a list in brackets; ``is_item`` asks for the first option of such a list.
    """
    path = config_dir() / f"{'train' if command == 'sweep' else command}.yaml"
    for entry in yaml.safe_load(path.read_text(encoding="utf-8")).get("defaults", []):
        if isinstance(entry, dict) and group in entry:
            chosen = entry[group]
            if not isinstance(chosen, list):
                return chosen
            return str(chosen[0]) if is_item else f"[{','.join(chosen)}]"
    return None


def _unknown_key(key: str, command: str, words: Sequence[str], settings: Sequence[str] | None) -> UserError:
    """Explain that a key does not exist, and look for it in another spelling or another place.

    ``settings`` are the overrides of the job that lacks the key; None means ``words``.
    """
    if (root := (key.partition(".")[0], command)) in MISPLACED:
        owner, reason = MISPLACED[root]
        line = _sweep_line(words) if owner == "sweep" else line_of(owner, words)
        return UserError(f"{key}: {reason}. Try: {line}")
    value = next((word.partition("=")[2] for word in words if key_of(word) == key), None)
    known = _known(key, command, words if settings is None else settings)
    if value is not None and key in known:
        line = shlex.join([f"~{key}", f"+{key}={value}"])
        return UserError(f"{key}: expected the keys of the present value, got others. Try: {line}")
    if value is not None and (owners := _options_with(key)):
        line = f"{owners[0]} {shlex.quote(f'{key}={value}')}"
        return UserError(f"{key}: a setting of {' and '.join(owners)}, not of the chosen option. Try: {line}")
    if value is not None:
        known = {name: node for name, node in known.items() if _fits(value, node)}
    last = key.rpartition(".")[2].lower()
    same_name = [name for name in known if name.rpartition(".")[2].lower() == last]
    suggestions = same_name or did_you_mean(key, list(known))
    if suggestions and value is not None:
        meant = " or ".join(suggestions[:3])
        changed = [f"{suggestions[0]}={value}" if key_of(word) == key else word for word in words]
        line = line_of(command, changed)
        return UserError(f"{key}: no such setting. Did you mean {meant}? Try: {line}")
    if command in ("train", "sweep") and value is not None and _is_colour(value):
        line = line_of(command, _with_colour(value, [word for word in words if key_of(word) != key]))
        return UserError(f"{key}: no such setting. The prompt describes colours. Try: {line}")
    # A sweep has such a page only for a line with jobs.
    page = "train" if command == "sweep" else command
    return UserError(f"{key}: no such setting. Try: {line_of(page, ['--cfg', 'job'])}")


def _is_colour(word: str) -> bool:
    """Return whether prompts may use ``word`` as a colour."""
    # This loads torch, so it is done only for a key that resembles no setting.
    from cadam3d.prior.shapes.vocabulary import COLOURS

    return word in COLOURS


def _with_colour(colour: str, words: Sequence[str]) -> list[str]:
    """Return ``words`` with a colour in the prompt, after its article if it begins with one."""
    changed, prompts = list(words), [word for word in words if key_of(word) == "prompt"]
    if not prompts:
        return [*changed, f"prompt=a {colour} torus"]
    text = prompts[0].partition("=")[2]
    changed[changed.index(prompts[0])] = "prompt=" + re.sub(r"^((?:an? |the )?)", rf"\1{colour} ", text)
    return changed


def _fits(value: str, node: object) -> bool:
    """Return whether the text ``value`` may be meant for a setting whose present value is ``node``.

    Only a word for a setting that holds numbers or a truth value is refused; all else may be a mistake.
    """
    is_word = re.fullmatch(r"[A-Za-z]\w*", value) and value.lower() not in ("true", "false", "null")
    return not is_word or not isinstance(node, bool | int | float | list | dict)


def _options_with(key: str) -> list[str]:
    """Return the options (such as ``densifier=cadam_open``) of the group of ``key`` that have its setting.

    Options that build on another one are left out, and so are options with a required value.
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


def _unreadable(override: str, reason: str) -> UserError:
    """Explain that Hydra's grammar cannot read a value, and quote it."""
    key, _, value = override.partition("=")
    line = f"{key}={quote(value)}"
    typed = shlex.quote(line) if re.search(r'["$`\\!]', line) else f'"{line}"'
    return UserError(f"{key}: cannot read the value ({reason}). Try: {typed}")


def _several_values(override: str, command: str, words: Sequence[str]) -> UserError:
    """Explain that several values need a sweep, or brackets if they are one list."""
    key, _, value = override.partition("=")
    example = shlex.quote(f"{key}=[{value}]")
    if isinstance(_known(key, command, words).get(key), list):
        return UserError(f"{key}: a list has brackets. Try: {example}")
    if command not in ("train", "sweep"):
        first = shlex.quote(f"{key}={value.partition(',')[0]}")
        return UserError(f"{key}: expected one value, got {value!r}. Try: {first}")
    line = _sweep_line(words)
    return UserError(f"{key}: several values make a sweep (a list is {example}). Try: {line}")
