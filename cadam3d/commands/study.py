"""``cadam3d study``: write the page of a blinded comparison, or evaluate the answers of its raters."""

import os
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from random import Random
from typing import Any

from omegaconf import DictConfig, OmegaConf

from cadam3d.commands.messages import note
from cadam3d.commands.opened import open_run, renderer
from cadam3d.core.checks import require_range, require_whole
from cadam3d.core.console import say
from cadam3d.core.errors import UserError
from cadam3d.io.asset_record import sha256_of
from cadam3d.io.atomic import replacing
from cadam3d.io.caption import plain
from cadam3d.io.jsonl import write_json
from cadam3d.io.prompt_files import read_prompts
from cadam3d.io.reading import read_text
from cadam3d.io.run_folder import (
    ASSET,
    expanded,
    nearest_existing,
    numbered,
    occupant,
    remove_empty,
    require_writable,
    setting_word,
    shown,
    typed_path,
)
from cadam3d.report.formatting import plural
from cadam3d.settings.compose import Call
from cadam3d.study.answers import (
    RESULTS_KIND,
    AnswerFile,
    LeftOut,
    collect,
    find_files,
    read_files,
)
from cadam3d.study.clips import LEAST_VISIBLE, ClipSettings, FilmedTurn, film, ruined
from cadam3d.study.key import KEY, PAGE, RESULTS, TABLE, Key, read_key, write_key
from cadam3d.study.rater_page import study_id, study_page
from cadam3d.study.runs import RunPair, StudyRun, draw_pairs, find_runs, pair_runs, select
from cadam3d.study.trials import StudyPlan, catch_count, make_plan

LARGEST_PAGE = 100_000_000  # bytes; above this, some mail servers and phones refuse a page
LARGEST_CONSENT = 1 << 16  # bytes
CONSENT = """Taking part is voluntary, and you can stop at any time without giving a reason.

This page sends nothing. Your answers, the time that each of them took, and the name or number that you type \
below stay in this browser until you save them as a file. You decide whether you send that file."""


def run(cfg: DictConfig, _call: Call) -> None:
    """Write the page and the key of a study of ``runs=``, or evaluate the files in ``answers=``."""
    if (cfg.runs is None) == (cfg.answers is None):
        got = "neither" if cfg.runs is None else "both"
        line = "cadam3d study --help" if cfg.runs is None else "answers=null"
        raise UserError(f"runs, answers: expected one of them, got {got}. Try: {line}")
    if cfg.answers is None:
        _write(cfg)
    else:
        _evaluate(cfg)


# The page.


def _write(cfg: DictConfig) -> None:
    """Write ``study.html`` and ``key.json`` into ``output``, and print what they contain."""
    settings = _settings(cfg)
    # The text that raters read before they begin.
    consent = CONSENT if cfg.consent is None else read_text(expanded(cfg.consent), largest=LARGEST_CONSENT)
    pairs = _pairs(cfg)
    generator = _generator(cfg.seed, pairs)
    pairs = draw_pairs(pairs, cfg.pairs, generator)
    with _output(cfg) as folder:
        clips = _film_all(pairs, cfg, settings)
        plan = _plan(cfg, pairs, clips, generator)
        frames = [
            ruined(clips[source.run], settings, number) if source.is_ruined else clips[source.run].frames
            for number, source in enumerate(plan.sources)
        ]
        study = study_id(plan.trials, frames)
        page = study_page(study, plan.trials, frames, seconds=float(settings.seconds), consent=consent)
        with replacing(folder / PAGE) as temporary:
            temporary.write_text(page, encoding="utf-8")
        write_key(folder / KEY, study, plan, seed=cfg.seed)
        _print_page(folder, pairs, plan)


def _settings(cfg: DictConfig) -> ClipSettings:
    """Return how clips are rendered, after all other settings of a page have been checked."""
    require_whole("seed", cfg.seed, low=0)
    require_range("catch_share", cfg.catch_share, low=0, high=1)
    if cfg.pairs is not None:
        require_whole("pairs", cfg.pairs, low=1)
    return ClipSettings(
        size=cfg.size,
        frames=cfg.frames,
        seconds=cfg.seconds,
        elevation_deg=cfg.elevation_deg,
        distance=cfg.distance,
        backdrop=list(cfg.backdrop),
        quality=cfg.quality,
    )


def _generator(seed: int, pairs: Sequence[RunPair]) -> Random:
    """Return what draws the order, the sides and the numbers of the clips.

    A rater may know this program and guess the seed. The draws also depend on the assets, which a page does
    not contain, so that they cannot be repeated from it.
    """
    runs = dict.fromkeys(run for pair in pairs for run in pair.runs)
    hashes = [sha256_of(run.folder / ASSET) for run in runs]
    return Random(f"{seed} {' '.join(hashes)}")


def _pairs(cfg: DictConfig) -> list[RunPair]:
    """Return all pairs of runs, and print a note if runs are left out."""
    found = find_runs(_texts(cfg.runs), None if cfg.labels is None else _texts(cfg.labels))
    prompts = None if cfg.prompts is None else {each.text for each in read_prompts(str(cfg.prompts))}
    runs = select(found.runs, None if cfg.arms is None else _texts(cfg.arms), prompts)
    pairs = pair_runs(runs, same_seed=cfg.same_seed)
    if found.without_asset:
        note(f"{plural(found.without_asset, 'run')} left no asset and cannot be shown")
    paired = {run for pair in pairs for run in pair.runs}
    if single := [str(shown(run.folder)) for run in runs if run not in paired]:
        note(f"{plural(len(single), 'run')} without a partner in another arm, such as {single[0]}")
    return pairs


@contextmanager
def _output(cfg: DictConfig) -> Iterator[Path]:
    """Yield the folder of the page, which is removed again if it stays empty.

    Raises ``UserError`` if it cannot be used.
    """
    text = str(cfg.output or "")
    folder = typed_path(text)
    free = setting_word("output", shown(numbered(folder.with_name(folder.name or "study"))))
    if not text.strip() or folder.parent == folder:
        raise UserError(f"output: expected a folder, got {text!r}. Try: output=study")
    # Without its key, the answers to a study are lost.
    found = KEY if os.path.lexists(folder / KEY) else occupant(folder) if folder.is_dir() else None
    if found:
        raise UserError(f"output: expected a folder of its own, got one with {found}. Try: {free}")
    existing = nearest_existing(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        require_writable(folder)
    except OSError as error:
        reason = error.strerror or error
        raise UserError(f"output: cannot write to {folder} ({reason}). Try: output=study") from error
    try:
        yield folder
    finally:
        remove_empty(folder, existing)


def _film_all(
    pairs: Sequence[RunPair], cfg: DictConfig, settings: ClipSettings
) -> dict[StudyRun, FilmedTurn]:
    """Return a clip of every run, rendered in the same way."""
    runs = list(dict.fromkeys(run for pair in pairs for run in pair.runs))
    clips = {}
    for number, each in enumerate(runs, 1):
        say(f"turntable {number} of {len(runs)}")
        gaussians = open_run(each.folder, cfg.device).gaussians
        clips[each] = film(renderer(cfg.rasterizer, gaussians), settings)
    return clips


def _plan(
    cfg: DictConfig, pairs: Sequence[RunPair], clips: dict[StudyRun, FilmedTurn], generator: Random
) -> StudyPlan:
    """Return the trials. Raises ``UserError`` if no clip shows enough for a catch trial."""
    catches = catch_count(len(pairs), cfg.catch_share)
    visible = [run for run, clip in clips.items() if clip.visible >= LEAST_VISIBLE]
    if catches and not visible:
        raise UserError(
            "backdrop: expected a colour in front of which the objects can be seen, got "
            f"{list(cfg.backdrop)}: no turntable shows anything. Try: 'backdrop=[0.5,0.5,0.5]'"
        )
    return make_plan(pairs, visible, catches, generator)


def _print_page(folder: Path, pairs: Sequence[RunPair], plan: StudyPlan) -> None:
    met = Counter(pair.arms for pair in pairs)
    for (one, other), count in sorted(met.items()):
        print(f"{one} and {other}: {plural(count, 'pair')}")
    size = (folder / PAGE).stat().st_size
    catches = len(plan.trials) - len(pairs)
    print(
        f"{plural(len(plan.trials), 'trial')}, of which {plural(catches, 'catch trial')}; {size / 1e6:.1f} MB"
    )
    print(f"for the raters:  {shown(folder / PAGE)}")
    print(f"keep it secret:  {shown(folder / KEY)}")
    if size > LARGEST_PAGE:
        note(f"the page is {size / 1e6:.0f} MB. To make it smaller, reduce size, frames or pairs")


# The answers.


def _evaluate(cfg: DictConfig) -> None:
    """Analyse the answers, print the result, and write ``study.json`` and ``study.md`` beside the key."""
    from cadam3d.study.analysis import analyse
    from cadam3d.study.summary import bullets, markdown

    require_range("least_caught", cfg.least_caught, low=0, high=1)
    paths = find_files(_texts(cfg.answers))
    files, left = read_files(paths)
    if not files:
        _warn_all(left)
        raise _no_answers(f"{plural(len(paths), 'file')} without any")
    place, key = _find_key(cfg, files)
    collected = collect(files, key)
    left += collected.left_out
    _warn_all(left)
    if not collected.raters:
        raise _no_answers(f"none to the study of {shown(place)}, for the reasons above")
    analysis = analyse(collected.raters, least_caught=float(cfg.least_caught))
    page = markdown(analysis)
    print(page)
    folder = place.parent
    listed = [{"file": plain(each.path.name), "reason": plain(each.reason)} for each in left]
    facts = {"study": key.study, "catch_trials": key.catch_trials, "trials": len(key.trials)}
    write_json(folder / RESULTS, {"kind": RESULTS_KIND, **facts, "left_out": listed, **analysis.to_json()})
    if listed:
        lines = bullets([f"{each['file']}: {each['reason']}" for each in listed])
        page += f"\nFiles that are left out:\n\n{lines}\n"
    with replacing(folder / TABLE) as temporary:
        temporary.write_text(page, encoding="utf-8")
    print(f"{shown(folder / RESULTS)}, {shown(folder / TABLE)}")


def _warn_all(left: Sequence[LeftOut]) -> None:
    for each in left:
        say(plain(f"Warning: {shown(each.path)} is left out: {each.reason}"))


def _no_answers(got: str) -> UserError:
    return UserError(f"answers: expected files that raters have saved, got {got}. Try: cadam3d study --help")


def _find_key(cfg: DictConfig, files: Sequence[AnswerFile]) -> tuple[Path, Key]:
    """Return the key of the study that most of the files are about, and its path."""
    if cfg.key is not None:
        path = expanded(cfg.key)
        return path, read_key(path / KEY if path.is_dir() else path)
    around = [place for file in files for place in list(file.path.absolute().parents)[:2]]
    paths = [folder / KEY for folder in dict.fromkeys([expanded(str(cfg.output)), *around])]
    keys = {path: read_key(path) for path in paths if path.is_file()}
    for study, _ in Counter(file.study for file in files).most_common():
        for path, key in keys.items():
            if key.study == study:
                return path, key
    others = ", ".join(str(shown(path)) for path in keys)
    raise UserError(
        f"key: expected the key of the study {files[0].study!r} in {cfg.output}/, beside the answers or in "
        f"the folder above, got {f'keys of other studies in {others}' if keys else 'none'}. "
        "Try: cadam3d study --help"
    )


def _texts(value: Any) -> list[str]:
    """Return the texts of a setting that is one text or a list of them."""
    return [str(item) for item in value] if OmegaConf.is_list(value) else [str(value)]
