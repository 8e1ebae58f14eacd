"""What follows "Try:" in a message works when it is pasted.

The tests type wrong lines, and wrong values of every setting, in a folder with a run, a sweep and some files.
They paste what each message suggests, and expect a line that is not refused any more. A suggestion is one of

- words for the line that was typed: overrides and flags, which replace those of the same key, or are added;
- a whole line that begins with ``cadam3d``;
- a line for the shell, such as ``pip install``.
"""

import ast
import contextlib
import copy
import io
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import jaxtyping
import numpy as np
import pytest
import torch
import trimesh
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.utils import get_class
from omegaconf import DictConfig, OmegaConf
from splats import make_gaussians

import cadam3d
from cadam3d import cli
from cadam3d.build import component
from cadam3d.compiled.build import find_compiler
from cadam3d.core.errors import UserError
from cadam3d.io.jsonl import write_json
from cadam3d.io.ply import write_ply
from cadam3d.rasterizer import auto
from cadam3d.rasterizer.cpu import load_kernels
from cadam3d.settings.advice import LAUNCHERS
from cadam3d.settings.compose import compose, flatten
from cadam3d.settings.options import config_dir
from cadam3d.sweep.folder import Plan, write_plan

PACKAGE = Path(cadam3d.__file__).parent
CHECKS = "core/checks.py"
# Raised instead of training, once everything that can be refused has been accepted.
ACCEPTED = "accepted"
OVERRIDE = re.compile(r"(?:[+~]{0,2}[A-Za-z_][\w./@]*=.*|~[A-Za-z_][\w./]*|--?[a-z-]+(?:=.*)?)", re.DOTALL)
SHELL = ("pip install ", "hf download ", "nvidia-smi", 'eval "$(cadam3d -sc install=bash)"')
A_CUBE = ("train", "prompt=a red cube", "prior=tiny")
A_STUDY = ("study", "runs=[an arm,another arm]")

# Wrong lines, by what is wrong with them. A run is in "a run" and in outputs/latest, a sweep in "a sweep".
LINES: dict[str, list[tuple[str, ...]]] = {
    "the command": [
        ("trian", "prompt=a red cube"),
        ("a red cube",),
        ("a", "red", "cube", "steps=5"),
        ("prompt=a red cube",),
        ("run=a run",),
        ("nonsense",),
        ("--nonsense",),
        ("-sc",),
        ("-sc", "install=tcsh"),
    ],
    "flags": [
        (*A_CUBE, "--nonsense"),
        (*A_CUBE, "--cfg", "job", "--info", "config"),
        (*A_CUBE, "--cfg", "nonsense"),
        (*A_CUBE, "--config-dir=configz"),
        ("train", "--help", "densifier=cadamm"),
        ("train", "--help", "densifer"),
        ("doctor", "--help", "densifier"),
    ],
    "words": [
        ("train", "a", "red", "cube"),
        ("render", "a run"),
        ("view", "asset.ply"),
        ("doctor", "json"),
        ("eval", "-m", "run=a run,a run"),
    ],
    "missing values": [("train", "seed=1"), ("sweep", "grid=densifiers")],
    "keys": [
        (*A_CUBE, "densifier.tau_q=0.5"),
        (*A_CUBE, "densifier.child_state=inherit"),
        (*A_CUBE, "nonsense.key=5"),
        (*A_CUBE, "color=red"),
        (
            *A_CUBE,
            "optimizer.means_lr={_target_: cadam3d.core.schedule.Steps, values: [0.1, 0.2], milestones: [5]}",
        ),
        ("train", "promt=a red cube"),
        (*A_CUBE, "grid=densifiers"),
        (*A_CUBE, "+densifier.nonsense=5"),
        (*A_CUBE, "+nonsense=5"),
        (*A_CUBE, "camera={}"),
        (*A_CUBE, "+callback.candidates.every=5"),
        (*A_CUBE, "~steps"),
        (*A_CUBE, "~densifier"),
        (*A_CUBE, "+steps=5"),
    ],
    "options": [
        (*A_CUBE, "densifier=cadm"),
        (*A_CUBE, "densifier=null"),
        (*A_CUBE, "callback=[metrics,progres]"),
        (*A_CUBE, "densifier._target_=cadam3d.nonsense.Nonsense"),
    ],
    "values": [
        (*A_CUBE, "steps=1,2"),
        (*A_CUBE, "background.color=1,0,0"),
        (*A_CUBE, "steps=[1"),
        (*A_CUBE, "steps=${nonsense}"),
        (*A_CUBE, "device=toaster"),
        (*A_CUBE, "camera=multiview", "views=3"),
        (*A_CUBE, "hydra.run.dir="),
        (*A_CUBE, "hydra.run.dir=/dev/null/x"),
        (*A_CUBE, "hydra.run.dir=a run"),
        (*A_CUBE, "guidance.t_min=0.9", "guidance.t_max=0.1"),
        (*A_CUBE, "exporter.turntable.fps=1e12"),
        (*A_CUBE, "densifier.reset=everything"),
        (*A_CUBE, "densifier=cadam_open", "densifier.reset=all", "densifier.tau_reset=1"),
        (*A_CUBE, "rasterizer=cuda"),
        (*A_CUBE, "rasterizer=gsplat"),
        (*A_CUBE, "seed=-1"),
    ],
    "attempts": [
        (*A_CUBE, "attempts=0"),
        (*A_CUBE, "attempts=2", "seed=-1"),
        (*A_CUBE, "attempts=2", "select=psnrr"),
        (*A_CUBE, "attempts=2", "select=mesh_fscore"),
        (*A_CUBE, "attempts=2", "metric=[]"),
        (*A_CUBE, "attempts=2", "hydra.run.dir=a run"),
        (*A_CUBE, "attempts=1", "dry_run=true"),
        ("train", "resume=a run", "attempts=2"),
        ("train", "resume=a sweep"),
        ("sweep", "prompt=a red cube", "densifier=cadam,none", "attempts=2"),
        ("sweep", "prompt=a red cube", "densifier=cadam,none", "dry_run=7"),
    ],
    "prompts": [
        ("train", "prompt=a red cuube"),
        ("train", "prompt="),
        ("train", "prompt=a cube red"),
        ("train", "prompt=a red and blue and green cube"),
        ("train", "prompt=a corgi", "prior=tiny", "truth=shapes"),
    ],
    "files of prompts": [
        ("sweep", "prompts=nowhere"),
        ("sweep", "prompts=text/broken.json"),
        ("sweep", "prompts=shapes6", "prompt=a red cube"),
        ("sweep", "prompts=shapes6", "prompts.shard=0/2"),
        ("sweep", "prompts=shapes6", "prompts.shard=1/9"),
        ("sweep", "prompts=shapes6", "prompts.first=0"),
        ("sweep", "prompts=shapes6", "prompts.category=Matter"),
        ("sweep", "prompts=text/prompts.txt", "prompts.category=Matter"),
        ("train", "prompts=shapes6"),
        ("train", "prompts.shard=1/2"),
    ],
    "files": [
        (*A_CUBE, "initializer=ply", "initializer.path=aset.ply"),
        (*A_CUBE, "initializer=ply", "initializer.path=text/broken.ply"),
        (*A_CUBE, "initializer=ply", "initializer.path=a box.ply"),
        (*A_CUBE, "initializer=ply", "initializer.path=asset.ply", "initializer.replicate=2"),
        (*A_CUBE, "initializer=mesh", "initializer.path=points.ply"),
    ],
    "runs": [
        ("train", "resume=nowhere"),
        ("train", "resume=a run", "hydra.run.dir=elsewhere"),
        ("sweep", "resume=a run", "seed=0,1"),
        ("render",),
        ("render", "run=nowhere"),
        ("render", "run=a run", "exporter=[]"),
        ("render", "run=a run", "ply=asset.ply"),
        ("render", "run=a sweep"),
        ("render", "run=a run", "labels=[one]"),
        ("render", "run=[a run]"),
        ("render", "run=[a run,nowhere]"),
        ("render", "run=[a run,a run]", "labels=[one]"),
        ("render", "run=[a run,a run]", "ply=asset.ply"),
        ("render", "run=[a run,a run]", "exporter=[ply]"),
        ("render", "run=a run", "exporter.turntable.background=transparent"),
        ("render", "run=a run", "exporter=[progress]"),
        ("export", "run=[a run,a run]"),
        ("render", "ply=nothing.ply"),
        ("export", "ply=a run"),
        ("render", "run=a run", "output=/dev/null/x"),
        ("export", "run=a run", "output=/dev/null/x.ply"),
        ("export", "run=new"),
        ("export", "run=a run", "output=a.b.fbx"),
        ("export", "run=a run", "output=taken"),
        ("export", "run=a run", "output=a run"),
        ("export", "ply=asset.ply", "output=asset.ply"),
        ("export", "run=a run", "for=unity", "output=a.ply"),
        ("export", "run=a run", "for=sparc"),
        ("export", "run=a run", "for=spark", "exporter=[ply]"),
        ("export", "run=a run", "for=spark", "output=a.glb"),
        ("render", "run=a run", "for=spark"),
        ("eval",),
        ("view", "run=nowhere"),
        ("view", "run=new"),
        ("view", "run=a run", "port=99999"),
        ("view", "run=a run", "browser=false"),
    ],
    "studies": [
        ("study",),
        ("study", "an arm", "another arm"),
        (*A_STUDY, "answers=answers"),
        (*A_STUDY, "labels=[one]"),
        (*A_STUDY, "arms=[one,two]"),
        (*A_STUDY, "prompts=nowhere"),
        (*A_STUDY, "prompts=[a cube]"),
        (*A_STUDY, "pairs=0"),
        (*A_STUDY, "catch_share=2"),
        (*A_STUDY, "seed=-1"),
        (*A_STUDY, "frames=0"),
        (*A_STUDY, "seconds=0"),
        (*A_STUDY, "backdrop=[1,2,3]"),
        (*A_STUDY, "size=abc"),
        (*A_STUDY, "consent=nowhere"),
        (*A_STUDY, "output="),
        (*A_STUDY, "output=/dev/null/x"),
        (*A_STUDY, "output=a run"),
        (*A_STUDY, "output=a study"),
        ("study", "runs=an arm"),
        ("study", "runs=a sweep"),
        ("study", "runs=[an arm,an arm]"),
        ("study", "runs=[an arm,nowhere]"),
        ("study", "runs=[an arm,an arm of cones]"),
        ("study", "runs=[an arm,a later arm]"),
        ("study", "answers=nowhere"),
        ("study", "answers=taken"),
        ("study", "answers=answers"),
        ("study", "answers=answers", "least_caught=2"),
        ("study", "answers=answers", "key=asset.ply"),
        ("study", "answers=answers", "key=a study"),
    ],
    "sweeps": [
        ("sweep", "prompt=a red cube"),
        ("sweep", "prompt=a red cube", "densifier=cadam,cadm"),
        ("sweep", "prompt=a red cube", "seed=0,1", "densifier.tau_q=1"),
        ("sweep", "prompt=a red cube", "grid=densfiers"),
        ("sweep", "prompt=a red cube", "grid=densifiers", "+grid.nonsense=1"),
        ("sweep", "prompt=a red cube", "seed=interval(0,1)"),
        ("sweep", "prompt=a red cube", "seed=0,1", "hydra.run.dir=x"),
        ("sweep", "prompt=a red cube", "seed=0,1", "hydra.sweep.dir="),
        ("sweep", "prompt=a red cube", "seed=0,1", "launcher=jobli"),
    ],
}
# Messages with a gap that only the user can fill.
GAPS = (
    r"^initializer\.path: no value given",
    r"Try: (?:another|download|resume=RUN)",  # damaged files
    r"Try: prior\.\w+=DIR$",  # models
)
LONGEST_WAY = 4  # messages
# Code whose messages need what these tests lack. A key is a folder, a file, or FILE::FUNCTION.
ELSEWHERE: dict[str, str] = {
    "commands/attempts.py::_keep": "needs a folder that cannot be written",
    "commands/attempts.py::_nothing_to_choose_by": "needs attempts that have ended; see tests/sweep",
    "commands/eval.py::_evaluate_sweep": "needs a sweep whose jobs all fail",
    "commands/eval.py::start_of": "needs the folder of a stranger",
    "commands/eval.py::_not_saved": "needs a folder that cannot be written; see tests/commands",
    "commands/study.py::_plan": "needs renders; see tests/commands/test_study.py",
    "commands/view.py::_listening": "needs a port that is in use; see tests/commands/test_view.py",
    "commands/train.py::build_trainer": "needs other steps in refine than in the run",
    "commands/train.py::require_unused": "see test_wrong_values.py",
    "commands/train.py::start_or_resume": "needs a checkpoint",
    "launch.py::launch": "passes on the message of another function",
    "launch.py::read_words": "belongs to the Python API; see tests/api",
    "report/": "needs the results of a sweep; see tests/report",
    "settings/advice.py::_job_refused": "passes on the message of a job",
    "settings/advice.py::_refused_path": "needs names that the system refuses; see test_cli.py",
    "settings/advice.py::explain": "needs YAML that cannot be read; see test_wrong_values.py",
    "settings/compose.py": "needs YAML of the user; see test_wrong_values.py and test_configs.py",
    "settings/declared.py::_require_described": "needs YAML of the user; see test_wrong_values.py",
    "settings/documentation.py": "needs a damaged installation",
    "settings/place.py": "needs a second process or a full disk; see tests/settings",
    "settings/trust.py": "needs the folder of a stranger; see tests/settings",
    "sweep/folder.py": "needs a damaged sweep",
    "sweep/grid.py": "needs a wrong grid; see tests/sweep",
    "sweep/start.py::_locked": "needs a second process",
    "sweep/choice.py::require_one_method": "needs attempts that were measured; see tests/sweep",
    "sweep/start.py::_refuse_occupied": "needs files in the way; see tests/sweep",
    "sweep/start.py::_refuse_other_settings": "needs the results of a sweep; see tests/sweep",
}
UPPER_FLOORS = ("settings/", "sweep/", "report/", "commands/", "launch.py", "cli.py")
# Options of which several can be chosen.
LISTS = ("exporter", "callback", "metric", "regularizer")
WRONG_VALUES = ("abc", None, -1e12)


@dataclass(frozen=True)
class Answer:
    """A wrong line, and the messages on the way to a line that is accepted, with each suggestion pasted."""

    line: str
    messages: list[str]
    is_accepted: bool  # in the end


@dataclass(frozen=True)
class Answers:
    """All answers, and the functions that raised an error, as FILE::FUNCTION."""

    to_lines: list[Answer]
    to_values: list[Answer]
    sites: set[str]


# --- what is pasted --------------------------------------------------------------------------------------


def is_words(hint: str) -> bool:
    """Return whether a hint consists of overrides and flags."""
    try:
        words = shlex.split(hint)
    except ValueError:
        return False
    return bool(words) and all(OVERRIDE.fullmatch(word) for word in words)


def is_pasteable(hint: str) -> bool:
    """Return whether a hint is words for the line, a line of cadam3d, or a known line of the shell."""
    if hint.startswith("cadam3d "):
        first = shlex.split(hint)[1]
        return first in cli.COMMANDS or first.startswith("-")
    return hint.startswith(SHELL) or is_words(hint)


def key_of(word: str) -> str:
    return word.partition("=")[0].lstrip("+~").replace("/", ".")


def hint_of(message: str) -> str:
    """Return what a message says to type."""
    return message.rpartition("Try: ")[2]


def has_gap(message: str) -> bool:
    return any(re.search(pattern, message) for pattern in GAPS)


def pasted(words: Sequence[str], hint: str) -> list[str]:
    """Return the line after a hint was pasted into it, or instead of it."""
    parts = shlex.split(hint)
    if parts[0] == "cadam3d":
        return parts[1:]
    keys = {key_of(part) for part in parts}
    return [word for word in words if key_of(word) not in keys] + parts


# --- typing ----------------------------------------------------------------------------------------------


def answer_to(words: Sequence[str]) -> str | None:
    """Return the message for a line in this process; None if the line is accepted."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        try:
            cli.dispatch(list(words))
        except UserError as error:
            return None if str(error) == ACCEPTED else str(error)
        except SystemExit as end:
            return f"exit code {end.code}" if end.code else None
    return None


def followed(line: str, first: str | None, paste: Callable[[str], str | None]) -> Answer:
    """Paste what a message suggests, and then what the next message suggests, until a line is accepted."""
    messages, message = [], first
    while message is not None and message not in messages and len(messages) < LONGEST_WAY:
        messages.append(message)
        hint = hint_of(message)
        if not is_pasteable(hint) or not hint.isprintable():
            break
        message = None if hint.startswith(SHELL) or has_gap(message) else paste(hint)
    return Answer(line, messages, message is None)


def answers_to_lines() -> Iterator[Answer]:
    said = cache(answer_to)
    for typed in (words for lines in LINES.values() for words in lines):
        words = list(typed)

        def paste(hint: str, words: list[str] = words) -> str | None:
            words[:] = pasted(words, hint)
            return said(tuple(words))

        yield followed(shlex.join(typed), said(typed), paste)


def classes() -> dict[str, list[str]]:
    """Return one option for each class and set of settings, by group."""
    found: dict[str, dict[Any, str]] = {}
    for path in sorted(config_dir().glob("*/*.yaml")):
        content = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
        if "_target_" in content:
            options = found.setdefault(path.parent.name, {})
            options.setdefault((content["_target_"], *sorted(content)), path.stem)
    return {group: list(options.values()) for group, options in found.items()}


def choices() -> Iterator[list[str]]:
    """Yield lines of options that together build every class."""
    groups = classes()
    one = {group: groups[group] for group in groups.keys() - {*LISTS, "hydra", "launcher"}}
    for number in range(max(map(len, one.values()))):
        line = [f"{group}={options[number]}" for group, options in one.items() if number < len(options)]
        if number == 0:
            stems = {
                group: sorted(path.stem for path in (config_dir() / group).glob("*.yaml")) for group in LISTS
            }
            line += [f"{group}=[{','.join(set(names) - {'none'})}]" for group, names in stems.items()]
        yield sorted(line)


def answers_to_values() -> Iterator[Answer]:
    tried: set[tuple[str, str]] = set()
    for line in choices():
        has_file = {"initializer=ply", "initializer=mesh"} & set(line)
        cfg = compose([A_CUBE[1], *(["initializer.path=a.ply"] if has_file else []), *line])
        known = {key for key, _ in flatten(OmegaConf.to_container(cfg, resolve=False), with_nodes=True)}
        for choice in line:
            group, _, name = choice.partition("=")
            members = [f"{group}.{member}" for member in cfg.get(group) or ()]
            for part in members if name.startswith("[") else [group]:
                if "_target_" in (OmegaConf.select(cfg, part) or ()):
                    yield from answers_about(cfg, part, line, known, tried)


def answers_about(
    cfg: DictConfig, part: str, line: Sequence[str], known: set[str], tried: set[tuple[str, str]]
) -> Iterator[Answer]:
    """Yield the answers to wrong values of each setting of one component, one for each suggestion.

    ``tried`` has the checks and keys of earlier components, which are not repeated: classes share both.
    """
    seen = set()
    owner = get_class(OmegaConf.select(cfg, part)._target_)
    for name, value in flatten(OmegaConf.to_container(OmegaConf.select(cfg, part), resolve=False)):
        key = f"{part}.{name}"
        judge = owner.__post_init__.__qualname__ if hasattr(owner, "__post_init__") else ""
        check = (f"{judge} {part}", name)
        if check in tried:
            continue
        tried.add(check)
        misspelled = (value[:-1],) if isinstance(value, str) and value and "${" not in value else ()
        for wrong in (*WRONG_VALUES, *misspelled) if not name.endswith("_target_") else ():
            first = built(cfg, part, {key: wrong})
            if first is None or (key, hint_of(first)) in seen:
                continue
            seen.add((key, hint_of(first)))
            values: dict[str, object] = {key: wrong}

            def paste(hint: str, values: dict[str, object] = values) -> str | None:
                if hint.startswith("cadam3d "):
                    return answer_to(pasted([], hint))
                words = shlex.split(hint)
                # An option such as initializer/fallback=ball replaces a value.
                for word in words:
                    values.pop(key_of(word), None)
                if not all(word.startswith(f"{part}.") for word in words):
                    lines = [f"{key}={as_typed(value)}" for key, value in values.items()]
                    changed = compose([A_CUBE[1], *pasted([*line, *lines], hint)])
                    return built(changed, part, {})
                if unknown := {key_of(word) for word in words} - known:
                    return f"no such settings: {unknown}"
                values.update({key_of(word): value_of(word) for word in words})
                return built(cfg, part, values)

            yield followed(f"{shlex.join(line)} {key}={wrong!r}", first, paste)


def built(cfg: DictConfig, part: str, values: Mapping[str, object]) -> str | None:
    """Return the message for a component with other values; None if it can be built."""
    node = copy.deepcopy(OmegaConf.select(cfg, part))
    node._set_parent(OmegaConf.select(cfg, part)._get_parent())
    for key, value in values.items():
        OmegaConf.update(node, key.removeprefix(f"{part}."), value, merge=False, force_add=True)
    try:
        component(node)
    except UserError as error:
        return str(error)
    return None


def value_of(word: str) -> object:
    return OverridesParser.create().parse_override(word).value()


def as_typed(value: object) -> str:
    """Return a value in Hydra's grammar."""
    return "''" if value == "" else yaml.safe_dump(value, default_flow_style=True).splitlines()[0]


# --- the answers -----------------------------------------------------------------------------------------


def make_places(folder: Path) -> None:
    """Put runs, a sweep and files into ``folder``, which the wrong lines name."""
    gaussians = make_gaussians(6)
    cfg = compose(["prompt=a red cube", "prior=tiny", "rasterizer=reference"])
    for run in ("a run", "a sweep/0", "new"):
        (folder / run / ".hydra").mkdir(parents=True)
        (folder / run / "config.yaml").write_text(OmegaConf.to_yaml(cfg, resolve=True), encoding="utf-8")
        (folder / run / ".hydra/overrides.yaml").write_text("['prompt=a red cube', 'prior=tiny']")
        write_ply(folder / run / "asset.ply", gaussians, up="-y", pad_sh=0)
    (folder / "new/asset.ply").unlink()
    make_study(folder)
    (folder / "a run/summary.json").write_text("{}")
    (folder / "outputs").mkdir()
    (folder / "outputs/latest").symlink_to(folder / "a run")
    write_plan(folder / "a sweep", Plan(cwd=str(folder), flags=[], threads=None, jobs=[]))
    write_ply(folder / "asset.ply", gaussians, up="-y", pad_sh=0)
    trimesh.creation.box().export(folder / "a box.ply")
    points = np.random.default_rng(0).normal(size=(9, 3))
    trimesh.PointCloud(points).export(folder / "points.ply")
    trimesh.PointCloud(points * np.nan).export(folder / "nan.ply")
    (folder / "configs").mkdir()
    (folder / "taken").mkdir()
    (folder / "taken/asset.json").write_text("{}")
    (folder / "text").mkdir()
    (folder / "text/broken.ply").write_text("no PLY file")
    (folder / "text/broken.json").write_text("no JSON")
    (folder / "text/prompts.txt").write_text("a red cube\na blue ball\n")


def make_study(folder: Path) -> None:
    """Put the runs of a study, its key and a file of answers into ``folder``."""
    arms = {"an arm": ("a cube", 0), "another arm": ("a cube", 0)}
    arms |= {"an arm of cones": ("a cone", 0), "a later arm": ("a cube", 1)}
    for arm, (prompt, seed) in arms.items():
        (folder / arm / "0").mkdir(parents=True)
        write_ply(folder / arm / "0/asset.ply", make_gaussians(6), up="-y", pad_sh=0)
        (folder / arm / "0/config.yaml").touch()
        write_json(folder / arm / "0/summary.json", {"prompt": prompt, "seed": seed})
    plain = {"version": 1, "study": "mine", "arms": [], "clips": [], "trials": []}
    write_json(folder / "a study/key.json", {"kind": "study key", **plain})
    plain = {"version": 1, "study": "other", "rater": "1", "session": "1", "saves": 1, "answers": []}
    write_json(folder / "answers/1.json", {"kind": "study answers", **plain})


def accept(*_: object, **__: object) -> None:
    raise UserError(ACCEPTED)


@pytest.fixture(scope="module")
def answers(tmp_path_factory) -> Iterator[Answers]:
    """Return the answers to all wrong lines and values, with nothing trained, rendered or opened."""
    folder, sites = tmp_path_factory.mktemp("hints"), set()
    build = UserError.__init__

    def record(self: UserError, *arguments: object) -> None:
        frame = sys._getframe(1)
        # The type checks of the suite put frames of their own between those of the package.
        while frame is not None:
            path = Path(frame.f_code.co_filename)
            sites.add(site_of(frame.f_code))
            if path.is_relative_to(PACKAGE) and path != PACKAGE / CHECKS:
                break
            frame = frame.f_back
        build(self, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(UserError, "__init__", record)
        patch.setenv("CXX", "no-such-compiler")
        patch.setattr("cadam3d.commands.train.remove_leftovers", accept)
        patch.setattr("cadam3d.sweep.start.write_plan", accept)
        patch.setattr("cadam3d.commands.doctor.run", accept)
        patch.setattr("cadam3d.commands.study.film", accept)
        patch.setattr("webbrowser.open", lambda _: True)
        patch.setattr("cadam3d.live.server.Server.serve_forever", accept)
        for exporter in ("images.ImagesExporter", "turntable.TurntableExporter", "preview.PreviewExporter"):
            for method in ("export", "compare"):
                patch.setattr(f"cadam3d.exporter.{exporter}.{method}", lambda *_: [folder / "a run"])
        # Otherwise the suite would refuse a wrong type before the component does.
        jaxtyping.config.update("jaxtyping_disable", True)
        make_places(folder)
        try:
            yield Answers(list(answers_to_lines()), list(answers_to_values()), sites)
        finally:
            jaxtyping.config.update("jaxtyping_disable", False)


def site_of(code: Any) -> str:
    """Return a function as FILE::FUNCTION, relative to the package."""
    path = Path(code.co_filename)
    name = path.relative_to(PACKAGE).as_posix() if path.is_relative_to(PACKAGE) else path.name
    return f"{name}::{code.co_qualname.partition('.<locals>')[0]}"


# --- the laws --------------------------------------------------------------------------------------------


def test_every_wrong_line_is_refused(answers):
    assert not [answer.line for answer in answers.to_lines if not answer.messages]


def test_what_a_message_suggests_can_be_pasted(answers):
    messages = {message for answer in answers.to_lines + answers.to_values for message in answer.messages}
    assert not [
        message for message in messages if not is_pasteable(hint_of(message)) and not has_gap(message)
    ]


def test_the_suggestions_lead_to_a_line_that_is_accepted(answers):
    everything = answers.to_lines + answers.to_values
    stuck = [answer for answer in everything if not answer.is_accepted and not has_gap(answer.messages[-1])]
    assert not stuck


def test_a_line_of_the_shell_is_well_formed_and_names_a_known_package(answers):
    known = (PACKAGE.parent / "pyproject.toml").read_text(encoding="utf-8")
    known += " ".join(LAUNCHERS.values())
    for message in {message for answer in answers.to_lines for message in answer.messages}:
        if (hint := hint_of(message)).startswith(SHELL):
            assert not subprocess.run(["bash", "-n", "-c", hint], check=False).returncode, hint
        for package in re.findall(r"^pip install (?:'cadam3d\[)?([\w-]+)", hint):
            assert package in known, hint


def test_every_message_of_the_upper_floors_is_provoked_here_or_has_a_reason(answers):
    """Below them are the components, whose constructors ``test_wrong_values.py`` covers."""
    missing = [
        site
        for site in sorted(sites_of_errors() - answers.sites)
        if site.startswith(UPPER_FLOORS) and not any(site.startswith(place) for place in ELSEWHERE)
    ]
    assert not missing, "Type a line that provokes each of these, or add a reason to ELSEWHERE."


def sites_of_errors() -> set[str]:
    """Return the functions of the package that raise ``UserError``, or call a check that does."""
    checks = ast.parse((PACKAGE / CHECKS).read_text(encoding="utf-8"))
    names = {"UserError", *(node.name for node in checks.body if isinstance(node, ast.FunctionDef))}
    found = set()
    for path in PACKAGE.rglob("*.py"):
        scopes: list[tuple[ast.AST, str]] = [(ast.parse(path.read_text(encoding="utf-8")), "")]
        while scopes:
            node, scope = scopes.pop()
            for child in ast.iter_child_nodes(node):
                is_scope = isinstance(child, ast.FunctionDef | ast.ClassDef)
                name = f"{scope}.{child.name}".lstrip(".") if is_scope else scope
                scopes.append((child, name))
                if (
                    isinstance(child, ast.Call)
                    and isinstance(child.func, ast.Name)
                    and child.func.id in names
                ):
                    found.add(f"{path.relative_to(PACKAGE).as_posix()}::{scope}")
    return found


def test_resuming_a_run_with_an_option_of_the_user_suggests_the_folder_of_that_time(type_line, tmp_path):
    own = tmp_path / "my configs/densifier"
    own.mkdir(parents=True)
    for number, sources in enumerate(
        (
            [{"path": str(own.parent), "provider": "command-line"}],
            [{"path": "gone", "provider": "command-line"}],
        )
    ):
        run = tmp_path / f"run-{number}"
        (run / ".hydra").mkdir(parents=True)
        (run / ".hydra/overrides.yaml").write_text("['prompt=a red cube', 'densifier=mine']")
        settings = {"hydra": {"runtime": {"config_sources": sources}}}
        (run / ".hydra/hydra.yaml").write_text(yaml.safe_dump(settings), encoding="utf-8")
        message = type_line("train", f"resume={run}", "steps=5").message
        folder = "DIR" if number else own.parent
        line = shlex.join(["cadam3d", "train", f"resume={run}", "steps=5", f"--config-dir={folder}"])
        assert message.startswith(f"densifier: the run in {run} uses 'mine', an option from a folder that ")
        assert message.endswith(f"Try: {line}")


@pytest.mark.parametrize("rasterizer", ["auto", "cpu"])
def test_kernels_that_cannot_be_kept_are_explained_with_words_that_work(rasterizer, tmp_path, monkeypatch):
    if find_compiler() is None:
        pytest.skip("needs a C++ compiler")
    (tmp_path / "a file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "a file"))
    part = component(compose([A_CUBE[1], f"rasterizer={rasterizer}"]).rasterizer)
    auto._choose.cache_clear()
    load_kernels.cache_clear()
    try:
        if rasterizer == "auto":
            message = part.prepare(torch.device("cpu")).reason
        else:
            with pytest.raises(UserError) as raised:
                part.prepare(torch.device("cpu"))
            message = str(raised.value)
        words = pasted([A_CUBE[1], f"rasterizer={rasterizer}"], hint_of(message))
        assert str(tmp_path / "a file") in message
        # The folder that is suggested need not be made: the words choose the kernels, and they compose.
        chosen = component(compose(words).rasterizer)
        assert chosen.cache_dir
        assert not Path(chosen.cache_dir).exists()
        assert Path(chosen.cache_dir).parent.is_dir()
    finally:
        auto._choose.cache_clear()
        load_kernels.cache_clear()
