"""Answers: read the files that raters send back, and find the arms that each answer is about.

The files come from strangers. A file that cannot be used is left out with a reason, and the others count.
"""

import glob
import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, TypeAdapter

from cadam3d.core.checks import fail
from cadam3d.core.errors import UserError
from cadam3d.io.caption import plain
from cadam3d.io.reading import read_bytes
from cadam3d.io.run_folder import expanded, shown
from cadam3d.study.key import KEY, RESULTS, Key
from cadam3d.study.questions import QUESTION_NAMES

LARGEST_FILE = 1 << 22  # bytes; an answer has about a hundred
# A text that can be printed, such as the name of a rater.
Name = Annotated[str, Field(max_length=64), AfterValidator(plain), Field(min_length=1)]


@dataclass(frozen=True)
class Answer:
    """One decision of one rater between two arms, about one question."""

    rater: str
    prompt: str
    question: str  # one of QUESTION_NAMES
    chosen: str  # the arm that won
    other: str  # the arm that lost; never the same as chosen


@dataclass(frozen=True)
class Rater:
    """All answers of one rater.

    If an arm has several runs of one prompt, there are several answers to each question about that prompt. A
    rater who stopped early has fewer answers and fewer catches than the others.
    """

    name: str  # unique in a study
    answers: tuple[Answer, ...]  # without catch trials
    catches: tuple[bool, ...]  # for each answered question of a catch trial, whether the answer was right


@dataclass(frozen=True)
class Pick:
    """An answer in a file: the clip that was chosen."""

    trial: Annotated[int, Field(ge=0)]
    question: str
    chosen: int


@dataclass(frozen=True)
class AnswerFile:
    """The answers that a rater has saved."""

    kind: Literal["study answers"]
    version: Literal[1]
    study: Name
    rater: Name
    session: Name  # drawn by the page when the rater began
    saves: int  # how often the rater had saved, this time included
    answers: tuple[Pick, ...]


def find_files(patterns: Sequence[str]) -> list[Path]:
    """Return the files that ``answers=`` names, each once, in order.

    An item is a file, a folder (for all ``.json`` files in it) or a pattern such as ``answers/*.json``.
    Raises ``UserError`` if an item names no file.
    """
    found: dict[Path, None] = {}
    for pattern in patterns:
        place = expanded(pattern)
        if place.is_dir():
            paths = sorted(place.glob("*.json"))
        elif os.path.lexists(place):
            paths = [place]
        else:
            paths = sorted(map(Path, glob.glob(str(place))))  # noqa: PTH207  (Path.glob refuses absolute patterns)
        if not paths:
            raise fail("answers", expected="files that raters have saved", got=pattern)
        found |= dict.fromkeys(paths)
    return list(found)


def read_files(paths: Sequence[Path]) -> tuple[dict[Path, AnswerFile], dict[Path, str]]:
    """Return the content of the files with answers, and the reason for each file that cannot be used.

    The key and the results of a study may be in the same folder. They are skipped.
    """
    reader = TypeAdapter(AnswerFile)
    files: dict[Path, AnswerFile] = {}
    left: dict[Path, str] = {}
    for path in paths:
        if path.name in (KEY, RESULTS):
            continue
        try:
            files[path] = reader.validate_json(read_bytes(path, largest=LARGEST_FILE), strict=True)
        except (UserError, ValueError) as error:
            reason = " ".join(str(error).split())[:100]
            left[path] = f"it is not a complete file of answers ({reason})"
    return files, left


def collect(files: Mapping[Path, AnswerFile], key: Key) -> tuple[list[Rater], dict[Path, str]]:
    """Return the raters of the study of ``key``, and the reason for each file that is left out.

    - A file of another study is left out, and so is a file with answers that do not fit the study.
    - A session is of one rater, even if its files have different names. The last file of it counts.
    - Two sessions under one name may be of two people, so all their files are left out. Upper and lower case
      are the same name.
    - A rater may have answered only some of the questions. These answers count.
    """
    raters: list[Rater] = []
    left: dict[Path, str] = {}
    sessions: dict[str, list[Path]] = defaultdict(list)
    for path, file in files.items():
        if _fits(file, key):
            sessions[file.session].append(path)
        else:
            left[path] = f"its answers are not about the study {key.study}"
    of_name: dict[str, list[Path]] = defaultdict(list)
    for paths in sessions.values():
        last = max(paths, key=lambda path: (files[path].saves, len(files[path].answers)))
        of_name[files[last].rater.casefold()].append(last)
        reason = f"{shown(last)} has the answers of the same session"
        left |= {path: reason for path in paths if path != last}
    for paths in of_name.values():
        if len(paths) == 1:
            raters.append(_rater(files[paths[0]], key))
            continue
        listed = ", ".join(str(shown(path)) for path in paths)
        left |= dict.fromkeys(paths, f"several sessions have the name of this rater: {listed}")
    return sorted(raters, key=lambda rater: rater.name.casefold()), left


def _fits(file: AnswerFile, key: Key) -> bool:
    """Return whether the answers in a file are about the study of ``key``, each about another question."""
    questions = {(pick.trial, pick.question) for pick in file.answers}
    return (
        file.study == key.study
        and 0 < len(questions) == len(file.answers)
        and all(
            pick.question in QUESTION_NAMES
            and pick.trial < len(key.trials)
            and pick.chosen in key.trials[pick.trial].clips
            for pick in file.answers
        )
    )


def _rater(file: AnswerFile, key: Key) -> Rater:
    answers, catches = [], []
    for pick in file.answers:
        trial = key.trials[pick.trial]
        if trial.right is not None:
            catches.append(pick.chosen == trial.right)
            continue
        [other] = set(trial.clips) - {pick.chosen}
        chosen, lost = key.clips[pick.chosen].run.arm, key.clips[other].run.arm
        answers.append(Answer(file.rater, trial.prompt, pick.question, chosen, lost))
    return Rater(file.rater, tuple(answers), tuple(catches))
