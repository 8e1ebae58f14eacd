"""Key: ``key.json``, which says what the clips of a page show. It stays with the experimenter."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cadam3d import __version__
from cadam3d.core.errors import UserError
from cadam3d.io.caption import plain
from cadam3d.io.jsonl import is_whole, parse_json, write_json
from cadam3d.io.reading import read_bytes
from cadam3d.io.run_folder import shown
from cadam3d.study.trials import StudyPlan, Trial

KEY = "key.json"
PAGE = "study.html"
RESULTS = "study.json"
TABLE = "study.md"
KIND = "study key"
VERSION = 1
LARGEST_KEY = 1 << 24  # bytes


@dataclass(frozen=True)
class Key:
    """The facts that are needed to read the answers to a study."""

    study: str  # its name, which the page and the files of answers have too
    arms: tuple[str, ...]
    clips: tuple[str, ...]  # the arm that each clip shows; of a ruined clip, that of its run
    trials: tuple[Trial, ...]

    @property
    def catch_trials(self) -> int:
        """Return the number of catch trials."""
        return sum(trial.right is not None for trial in self.trials)


def write_key(path: Path, study: str, plan: StudyPlan, *, seed: int) -> None:
    """Write the key of a study. Raises ``UserError`` if the file cannot be written."""
    write_json(
        path,
        {
            "kind": KIND,
            "version": VERSION,
            "study": study,
            "cadam3d": __version__,
            "seed": seed,
            "arms": sorted({source.run.arm for source in plan.sources}),
            "clips": [
                {
                    "arm": source.run.arm,
                    "prompt": source.run.prompt,
                    "seed": source.run.seed,
                    "conditions": dict(source.run.conditions),
                    "run": str(shown(source.run.folder)),
                    "is_ruined": source.is_ruined,
                }
                for source in plan.sources
            ],
            "trials": [
                {"prompt": trial.prompt, "clips": list(trial.clips), "right": trial.right}
                for trial in plan.trials
            ],
        },
    )


def read_key(path: Path) -> Key:
    """Return the key in a file. Raises ``UserError`` if the file is not the key of a study."""
    try:
        content = read_bytes(path, largest=LARGEST_KEY)
    except UserError as error:
        reason = str(error).partition(". Try: ")[0]
        raise UserError(f"key: expected the key of a study, got {reason}. Try: key=null") from error
    try:
        value = parse_json(content)
        return _key(value)
    except (ValueError, TypeError, KeyError, IndexError, RecursionError) as error:
        reason = " ".join(str(error).split())[:200]
        raise UserError(
            f"key: expected the key of a study, got {str(shown(path))!r}, which is not one ({reason}). "
            "Try: cadam3d study --help"
        ) from error


def is_key(value: Any) -> bool:
    """Return whether a value from a JSON file says that it is the key of a study."""
    return isinstance(value, dict) and value.get("kind") == KIND


def _key(value: Any) -> Key:
    """Return the key that plain JSON describes. Raises ``ValueError`` and the like for any other value."""
    if not is_key(value):
        raise ValueError(f"it has no kind {KIND!r}")
    if value["version"] != VERSION:
        raise ValueError(f"version {value['version']!r}; this program reads version {VERSION}")
    arms = tuple(_text(arm) for arm in _list(value["arms"]))
    clips = tuple(_text(clip["arm"]) for clip in _list(value["clips"]))
    if not set(clips) <= set(arms):
        raise ValueError("a clip is of an unknown arm")
    if any(plain(arm) != arm for arm in arms):
        raise ValueError("the name of an arm cannot be printed")
    trials = tuple(_trial(trial, len(clips)) for trial in _list(value["trials"]))
    if any(trial.right is None and len({clips[clip] for clip in trial.clips}) < 2 for trial in trials):
        raise ValueError("a trial compares an arm with itself")
    return Key(_text(value["study"]), arms, clips, trials)


def _trial(value: Any, clips: int) -> Trial:
    one, other = (_number(each, clips) for each in _list(value["clips"]))
    right = value["right"]
    if one == other or (right is not None and _number(right, clips) not in (one, other)):
        raise ValueError("a trial does not have two different clips")
    return Trial(_text(value["prompt"]), (one, other), right)


def _list(value: Any) -> Sequence[Any]:
    if not isinstance(value, list):
        raise ValueError("a list is missing")
    return value


def _text(value: Any) -> str:
    if not isinstance(value, str) or not value:
        raise ValueError("a text is missing")
    return value


def _number(value: Any, below: int) -> int:
    if not is_whole(value) or value >= below:
        raise ValueError("the number of a clip is wrong")
    return value
