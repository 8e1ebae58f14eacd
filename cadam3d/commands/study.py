"""``cadam3d study``: write the page of a blinded comparison, or evaluate the answers of its raters."""

import os
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from random import Random
from typing import Any

from omegaconf import DictConfig, OmegaConf

from cadam3d.commands.messages import note
from cadam3d.commands.opened import open_run, renderer
from cadam3d.core.checks import fail
from cadam3d.core.console import say, show
from cadam3d.core.errors import UserError
from cadam3d.io.asset_record import sha256_of
from cadam3d.io.atomic import replacing
from cadam3d.io.caption import plain
from cadam3d.io.jsonl import write_json
from cadam3d.io.prompt_files import read_prompts
from cadam3d.io.reading import read_text
from cadam3d.io.run_folder import (
    ASSET,
    claim,
    expanded,
    nearest_existing,
    numbered,
    occupant,
    remove_empty,
    setting_word,
    shown,
    typed_path,
)
from cadam3d.io.text_tables import bullets
from cadam3d.settings.compose import Call
from cadam3d.study.answers import collect, find_files, read_files
from cadam3d.study.clips import LEAST_VISIBLE, ClipSettings, film, ruined
from cadam3d.study.estimates import least_units
from cadam3d.study.key import KEY, PAGE, RESULTS, TABLE, read_key, write_key
from cadam3d.study.questions import QUESTIONS
from cadam3d.study.rater_page import study_id, study_page
from cadam3d.study.runs import RunPair, StudyRun, draw_pairs, find_runs, pair_runs, select
from cadam3d.study.trials import catch_count, make_plan

LARGEST_CONSENT = 1 << 16  # bytes
CONSENT = """Taking part is voluntary, and you can stop at any time without giving a reason.

This page sends nothing. Your answers, the time that each of them took, and the name or number that you type \
below stay in this browser until you save them as a file. You decide whether you send that file."""


def run(cfg: DictConfig, _call: Call) -> None:
    """Write the page and the key of a study of ``runs=``, or evaluate the files in ``answers=``."""
    if (cfg.runs is None) == (cfg.answers is None):
        got = "neither" if cfg.runs is None else "both"
        raise UserError(f"runs, answers: expected one of them, got {got}. Try: cadam3d study --help")
    if cfg.answers is None:
        _write(cfg)
    else:
        _evaluate(cfg)


def _write(cfg: DictConfig) -> None:
    """Write ``study.html`` and ``key.json`` into ``output``, and print what they contain."""
    settings = ClipSettings(**{each.name: cfg[each.name] for each in fields(ClipSettings)})
    # The text that raters read before they begin.
    consent = CONSENT if cfg.consent is None else read_text(expanded(cfg.consent), largest=LARGEST_CONSENT)
    pairs = _pairs(cfg)
    # A rater may know this program and guess the seed. The draws also depend on the assets, which a page does
    # not contain, so that they cannot be repeated from it.
    hashes = (sha256_of(run.folder / ASSET) for run in _runs_in(pairs))
    generator = Random(f"{cfg.seed} {' '.join(hashes)}")
    pairs = draw_pairs(pairs, cfg.pairs, generator)
    folder = typed_path(cfg.output)
    # Without its key, the answers to a study are lost.
    if found := KEY if os.path.lexists(folder / KEY) else occupant(folder):
        free = setting_word("output", shown(numbered(folder)))
        raise UserError(f"output: expected a folder of its own, got one with {found}. Try: {free}")
    existing = nearest_existing(folder)
    claim(folder, "output", is_chosen=True)
    try:
        _write_page(cfg, settings, consent, pairs, generator, folder)
    finally:
        remove_empty(folder, existing)


def _runs_in(pairs: Sequence[RunPair]) -> list[StudyRun]:
    """Return every run of the pairs once."""
    return list(dict.fromkeys(run for pair in pairs for run in pair.runs))


def _pairs(cfg: DictConfig) -> list[RunPair]:
    """Return all pairs of runs, and print a note if runs are left out."""
    found = find_runs(_texts(cfg.runs), None if cfg.labels is None else _texts(cfg.labels))
    prompts = None if cfg.prompts is None else {each.text for each in read_prompts(str(cfg.prompts))}
    runs = select(found, None if cfg.arms is None else _texts(cfg.arms), prompts)
    pairs = pair_runs(runs, same_seed=cfg.same_seed)
    if single := set(runs) - set(_runs_in(pairs)):
        example = min(str(shown(run.folder)) for run in single)
        note(f"{len(single)} run(s) without a partner in another arm, such as {example}")
    return pairs


def _write_page(
    cfg: DictConfig,
    settings: ClipSettings,
    consent: str,
    pairs: Sequence[RunPair],
    generator: Random,
    folder: Path,
) -> None:
    runs = _runs_in(pairs)
    clips = {}
    for number, each in enumerate(runs, 1):
        say(f"turntable {number} of {len(runs)}")
        gaussians = open_run(each.folder, cfg.device).gaussians
        clips[each] = film(renderer(cfg.rasterizer, gaussians), settings)
    catches = catch_count(len(pairs), cfg.catch_share)
    visible = [run for run, clip in clips.items() if clip.visible >= LEAST_VISIBLE]
    if catches and not visible:
        expected = "a colour in front of which the objects can be seen"
        raise fail("backdrop", expected=expected, got=list(cfg.backdrop), example="'backdrop=[0.5,0.5,0.5]'")
    plan = make_plan(pairs, visible, catches, generator)
    frames = [
        ruined(clips[source.run], settings, number) if source.is_ruined else clips[source.run].frames
        for number, source in enumerate(plan.sources)
    ]
    study = study_id(plan.trials, frames)
    page = study_page(study, plan.trials, frames, seconds=float(settings.seconds), consent=consent)
    with replacing(folder / PAGE) as temporary:
        temporary.write_text(page, encoding="utf-8")
    write_key(folder / KEY, study, plan, seed=cfg.seed)
    for (one, other), count in sorted(Counter(pair.arms for pair in pairs).items()):
        show(f"{one} and {other}: {count} pair(s)")
    _note_certainty(pairs)
    show(f"{len(plan.trials)} trial(s), of which {catches} are catch trials; {len(page) / 1e6:.1f} MB")
    show(f"for the raters:  {shown(folder / PAGE)}")
    show(f"keep it secret:  {shown(folder / KEY)}")


def _note_certainty(pairs: Sequence[RunPair]) -> None:
    """Print how many raters a certain difference needs, or that the pairs have too few prompts for one."""
    prompts: dict[tuple[str, str], set[str]] = defaultdict(set)
    for pair in pairs:
        prompts[pair.arms].add(pair.prompt)
    comparisons = len(QUESTIONS) * len(prompts)
    least = least_units(comparisons)
    needs = (
        f"needs at least {least} raters and {least} prompts: with fewer, p >= 0.05 even if all agree, "
        f"because it is corrected for {comparisons} comparisons"
    )
    arms = sorted(prompts.items())
    few = [f"{one} and {other} ({len(known)} prompts)" for (one, other), known in arms if len(known) < least]
    if few:
        note(f"no difference can be certain between {', '.join(few)}. That {needs}.")
    else:
        show(f"A certain difference {needs}.")


def _evaluate(cfg: DictConfig) -> None:
    """Analyse the answers, print the result, and write ``study.json`` and ``study.md`` beside the key."""
    from cadam3d.study.analysis import analyse
    from cadam3d.study.summary import markdown

    files, left = read_files(find_files(_texts(cfg.answers)))
    path = expanded(cfg.output if cfg.key is None else cfg.key)
    key = read_key(path := path / KEY if path.is_dir() else path)
    raters, others = collect(files, key)
    left |= others
    for file, reason in left.items():
        say(plain(f"Warning: {shown(file)} is left out: {reason}"))
    listed = [{"file": plain(file.name), "reason": plain(reason)} for file, reason in left.items()]
    analysis = analyse(raters, least_caught=float(cfg.least_caught))
    page = markdown(analysis)
    show(page)
    place = path.parent
    facts = {
        "study": key.study,
        "catch_trials": sum(trial.right is not None for trial in key.trials),
        "trials": len(key.trials),
    }
    write_json(place / RESULTS, {"kind": "study results", **facts, "left_out": listed, **analysis.to_json()})
    if listed:
        lines = bullets([f"{each['file']}: {each['reason']}" for each in listed])
        page += f"\nFiles that are left out:\n\n{lines}\n"
    with replacing(place / TABLE) as temporary:
        temporary.write_text(page, encoding="utf-8")
    show(f"{shown(place / RESULTS)}, {shown(place / TABLE)}")


def _texts(value: Any) -> list[str]:
    """Return the texts of a setting that is one text or a list of them."""
    return [str(item) for item in value] if OmegaConf.is_list(value) else [str(value)]
