"""Key: ``key.json``, which says what the clips of a page show. It stays with the experimenter."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import TypeAdapter

from cadam3d import __version__
from cadam3d.core.checks import fail
from cadam3d.core.errors import UserError
from cadam3d.io.jsonl import write_json
from cadam3d.io.reading import read_bytes
from cadam3d.io.run_folder import shown
from cadam3d.study.trials import ClipSource, StudyPlan, Trial

KEY = "key.json"
PAGE = "study.html"
RESULTS = "study.json"
TABLE = "study.md"
LARGEST_KEY = 1 << 24  # bytes


@dataclass(frozen=True, kw_only=True)
class Key:
    """The facts that are needed to read the answers to a study, as the file has them."""

    kind: Literal["study key"] = "study key"
    version: Literal[1] = 1
    study: str  # its name, which the page and the files of answers have too
    cadam3d: str = __version__
    seed: int
    clips: tuple[ClipSource, ...]
    trials: tuple[Trial, ...]


def write_key(path: Path, study: str, plan: StudyPlan, *, seed: int) -> None:
    """Write the key of a study. Raises ``UserError`` if the file cannot be written."""
    key = Key(study=study, seed=seed, clips=plan.sources, trials=plan.trials)
    write_json(path, TypeAdapter(Key).dump_python(key, mode="json"))


def read_key(path: Path) -> Key:
    """Return the key in a file. Raises ``UserError`` if the file is not the key of a study."""
    try:
        key = TypeAdapter(Key).validate_json(read_bytes(path, largest=LARGEST_KEY), strict=True)
    except (UserError, ValueError) as error:
        raise fail("key", expected="the key of a study", got=str(shown(path))) from error
    clips = set(range(len(key.clips)))
    if not all(len(clips.intersection(trial.clips)) == 2 for trial in key.trials):
        raise fail("key", expected="two clips in each trial", got=str(shown(path)))
    return key
