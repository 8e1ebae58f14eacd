"""Key: ``key.json``, which says what the clips of a page show. It stays with the experimenter."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import TypeAdapter

from cadam3d import __version__
from cadam3d.core.errors import UserError
from cadam3d.io.caption import plain
from cadam3d.io.jsonl import write_json
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
        return _key(read_bytes(path, largest=LARGEST_KEY))
    except (UserError, ValueError) as error:
        reason = " ".join(str(error).partition(". Try: ")[0].split())[:200]
        raise UserError(
            f"key: expected the key of a study, got {str(shown(path))!r} ({reason}). "
            "Try: cadam3d study --help"
        ) from error


@dataclass(frozen=True)
class _ClipInFile:
    arm: str


@dataclass(frozen=True)
class _KeyInFile:
    """The entries of the file that are read."""

    kind: Literal["study key"]
    version: Literal[1]
    study: str
    arms: tuple[str, ...]
    clips: tuple[_ClipInFile, ...]
    trials: tuple[Trial, ...]


def _key(content: bytes) -> Key:
    """Return the key in the bytes of a file. Raises ``ValueError`` for any other content."""
    found = TypeAdapter(_KeyInFile).validate_json(content, strict=True)
    clips = tuple(clip.arm for clip in found.clips)
    if not set(clips) <= set(found.arms) or any(plain(arm) != arm for arm in found.arms):
        raise ValueError("a clip is of an unknown arm, or the name of an arm cannot be printed")
    for trial in found.trials:
        if len(set(trial.clips)) < 2 or not all(0 <= clip < len(clips) for clip in trial.clips):
            raise ValueError("a trial does not have two different clips")
        arms = {clips[clip] for clip in trial.clips}
        if trial.right not in (None, *trial.clips) or (trial.right is None and len(arms) < 2):
            raise ValueError("a trial has a wrong answer, or it compares an arm with itself")
    return Key(found.study, found.arms, clips, found.trials)
