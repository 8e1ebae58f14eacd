"""Answers: read the files that raters send back, and find the arms that each answer is about.

The files come from strangers. A file that cannot be used is left out with a reason, and the others count.
"""

import glob
import os
from codecs import BOM_UTF8
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, TypeAdapter

from cadam3d.core.errors import UserError
from cadam3d.io.caption import plain
from cadam3d.io.jsonl import parse_json
from cadam3d.io.reading import read_bytes
from cadam3d.io.run_folder import expanded, shown
from cadam3d.study.key import KIND as KEY_KIND
from cadam3d.study.key import Key
from cadam3d.study.questions import QUESTION_NAMES

RESULTS_KIND = "study results"
LARGEST_FILE = 1 << 22  # bytes; an answer has about a hundred
LONGEST_NAME = 60  # characters, as on the page
LONGEST_ID = 64  # characters
MOST_FILES = 10_000


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
    answers: tuple[Answer, ...]  # without those of catch trials
    catches: tuple[bool, ...]  # for each answered question of a catch trial, whether the answer was right


@dataclass(frozen=True)
class Pick:
    """An answer in a file: the clip that was chosen."""

    trial: Annotated[int, Field(ge=0)]
    question: str
    chosen: int


@dataclass(frozen=True)
class AnswerFile:
    """The choices that a rater has saved."""

    path: Path
    study: str
    rater: str
    session: str  # drawn by the page when the rater began
    saves: int  # how often the rater had saved, this time included
    choices: tuple[Pick, ...]


@dataclass(frozen=True)
class LeftOut:
    """A file that is not used, and why."""

    path: Path
    reason: str


@dataclass(frozen=True)
class Collected:
    """The raters of a study, and the files that are left out."""

    raters: list[Rater]
    left_out: list[LeftOut]


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
            reason = "has no .json file" if place.is_dir() else "there is no such file"
            raise UserError(
                f"answers: expected files that raters have saved, got {pattern!r} ({reason}). "
                "Try: cadam3d study --help"
            )
        found |= dict.fromkeys(paths)
    if len(found) > MOST_FILES:
        raise UserError(
            f"answers: expected at most {MOST_FILES} files, got {len(found)}. Try: cadam3d study --help"
        )
    return list(found)


def read_files(paths: Sequence[Path]) -> tuple[list[AnswerFile], list[LeftOut]]:
    """Return the content of the files with answers, and the files that cannot be used.

    The key and the results of a study may be in the same folder. They are skipped without a message.
    """
    files: list[AnswerFile] = []
    left: list[LeftOut] = []
    for path in paths:
        try:
            # Some editors on Windows put a mark before the text.
            content = read_bytes(path, largest=LARGEST_FILE).removeprefix(BOM_UTF8)
            value = parse_json(content)
            if isinstance(value, dict) and value.get("kind") in (KEY_KIND, RESULTS_KIND):
                continue
            files.append(_file(path, content))
        except UserError as error:
            # Its beginning is the path, and its end is a hint to use another file.
            reason = str(error).removeprefix(f"{path}: ").partition(". Try: ")[0]
            left.append(LeftOut(path, reason))
        except (ValueError, RecursionError) as error:
            reason = " ".join(str(error).split())[:100]
            left.append(LeftOut(path, f"it is not a complete file of answers ({reason})"))
    return files, left


def collect(files: Sequence[AnswerFile], key: Key) -> Collected:
    """Return the raters of the study of ``key`` with their answers about arms.

    - A file of another study is left out, and so is a file with answers that do not fit the study.
    - A session is of one rater, even if its files have different names. The last file of it counts.
    - Two sessions under one name may be of two people, so all their files are left out. Upper and lower case
      are the same name.
    - A rater may have answered only some of the questions. These answers count.
    """
    raters: list[Rater] = []
    left: list[LeftOut] = []
    sessions: dict[str, list[AnswerFile]] = defaultdict(list)
    for file in files:
        problem = _problem(file, key)
        if problem:
            left.append(LeftOut(file.path, problem))
        else:
            sessions[file.session].append(file)
    of_name: dict[str, list[AnswerFile]] = defaultdict(list)
    for same in sessions.values():
        last = max(same, key=lambda file: (file.saves, len(file.choices)))
        of_name[last.rater.casefold()].append(last)
        newer = shown(last.path)
        left += [
            LeftOut(file.path, f"{newer} has the answers of the same session")
            for file in same
            if file is not last
        ]
    for same in of_name.values():
        if len(same) == 1:
            raters.append(_rater(same[0], key))
            continue
        for file in same:
            others = ", ".join(str(shown(other.path)) for other in same if other is not file)
            reason = f"another person or session has the same name {file.rater!r}: {others}"
            left.append(LeftOut(file.path, reason))
    return Collected(sorted(raters, key=lambda rater: rater.name.casefold()), left)


@dataclass(frozen=True)
class _Saved:
    """The entries of a file that are read."""

    kind: Literal["study answers"]
    version: Literal[1]
    study: Annotated[str, Field(min_length=1, max_length=LONGEST_ID)]
    rater: Annotated[str, Field(min_length=1, max_length=LONGEST_NAME)]
    session: Annotated[str, Field(min_length=1, max_length=LONGEST_ID)]
    saves: Annotated[int, Field(ge=0)]
    answers: tuple[Pick, ...]


def _file(path: Path, content: bytes) -> AnswerFile:
    """Return the answers in the bytes of a file. Raises ``ValueError`` for any other content."""
    saved = TypeAdapter(_Saved).validate_json(content, strict=True)
    if len({(pick.trial, pick.question) for pick in saved.answers}) < len(saved.answers):
        raise ValueError("a question is answered twice")
    # A name may have characters that cannot be seen, such as those inside some emoji and Persian words.
    rater = plain(saved.rater)
    if not all((rater, saved.study.isprintable(), saved.session.isprintable())):
        raise ValueError("rater, study, session: expected texts that can be printed")
    return AnswerFile(path, saved.study, rater, saved.session, saved.saves, saved.answers)


def _problem(file: AnswerFile, key: Key) -> str:
    """Return why the answers in a file are not about the study of ``key``; "" if they are."""
    if file.study != key.study:
        return f"it is of another study ({file.study!r})"
    if not file.choices:
        return "it has no answers"
    for choice in file.choices:
        is_known = choice.question in QUESTION_NAMES and choice.trial < len(key.trials)
        if not is_known or choice.chosen not in key.trials[choice.trial].clips:
            return "an answer does not fit the study"
    return ""


def _rater(file: AnswerFile, key: Key) -> Rater:
    return Rater(file.rater, tuple(_answers(file, key)), tuple(_catches(file, key)))


def _answers(file: AnswerFile, key: Key) -> Iterator[Answer]:
    for choice in file.choices:
        trial = key.trials[choice.trial]
        if trial.right is None:
            [other] = set(trial.clips) - {choice.chosen}
            chosen, lost = key.clips[choice.chosen], key.clips[other]
            yield Answer(file.rater, trial.prompt, choice.question, chosen, lost)


def _catches(file: AnswerFile, key: Key) -> Iterator[bool]:
    for choice in file.choices:
        right = key.trials[choice.trial].right
        if right is not None:
            yield choice.chosen == right
