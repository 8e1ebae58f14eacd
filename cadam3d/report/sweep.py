"""report.html of a sweep: the verdict in words, the key table, the figures, and what went wrong."""

import shlex
from collections import Counter
from collections.abc import Callable, Sequence
from html import escape
from importlib import resources
from pathlib import Path
from urllib.parse import quote

import yaml
from matplotlib.figure import Figure

from cadam3d import __version__
from cadam3d.core.checks import UserError, fail
from cadam3d.io.atomic import replacing
from cadam3d.io.jsonl import read_json
from cadam3d.report import figures, pictures, tables, words
from cadam3d.report.claims import compare, standard
from cadam3d.report.page import details, outcome_chip, page, tile
from cadam3d.report.rows import COMPLETE, NOISE, PLAN, PROMPT, SEED, UNFINISHED, Row, read, with_noise
from cadam3d.report.style import css, inline, styled, write_figure

FILE_NAME = "report.html"
FOLDER_NAME = "figures"  # of the sweep: every figure as SVG and PNG, every table as CSV
Draw = Callable[[Sequence[Row]], Figure | None]
FIGURES: dict[str, tuple[Draw, str, str]] = {  # name -> how, title, what to see
    "frontier": (
        figures.frontier_figure,
        "Quality against count",
        "Up and to the left is better: more PSNR from fewer Gaussians. A mark is one setting, its thresholds "
        "beside it, the standard one ringed: medians over cells. Thick bars are the spread over seeds, thin "
        "ones quartiles over cells. Hollow: cells are missing; dagger: jobs ended early. Dashed: the best "
        "that any arm reaches with the same seeds without noise.",
    ),
    "frontier_ssim": (
        figures.frontier_ssim_figure,
        "Structure against count",
        "The same in SSIM: up and to the left is better.",
    ),
    "growth": (
        figures.growth_figure,
        "Gaussians over time",
        "Who stops by itself levels off; who does not, climbs. Medians over cells, quartiles shaded.",
    ),
    "snr": (
        figures.snr_figure,
        "Signal to noise of the gradients over time",
        "Darker is more Gaussians. Those above tau_SNR may grow; pure white noise alone has the SNR of the "
        "other line.",
    ),
    "masks": (
        pictures.masks_figure,
        "Whom each arm chose",
        "Selected Gaussians in vermilion, before each refinement; an arm that listens to noise paints "
        "everything.",
    ),
    "thresholds": (
        figures.thresholds_figure,
        "Thresholds against each other",
        "How count and quality follow the two thresholds, medians over cells; the standard setting is bold.",
    ),
    "regimes": (
        pictures.regimes_figure,
        "Under, balanced, over",
        "The same scene under the thresholds that leave fewest Gaussians, the standard ones and the loosest.",
    ),
    "ablation": (
        pictures.ablation_figure,
        "Arm by arm",
        "The same scene from the same start: only the arm differs.",
    ),
    "objectives": (
        pictures.objectives_figure,
        "Objectives and arms",
        "One scene under each objective (rows) and arm (columns), with the count and PSNR it ended with.",
    ),
}


def write(sweep_folder: Path, names: Sequence[str] | None = None) -> Path:
    """Write ``report.html`` and ``figures/`` of the sweep in ``sweep_folder`` from whatever jobs are there.

    ``names`` are the figures to draw, of ``FIGURES``; ``None``: those that its grid names, else all that the
    data allow. Raises ``UserError`` if the folder holds no job, for a figure that does not exist, and if
    nothing can be written.
    """
    rows = read(sweep_folder)
    if not rows:
        raise UserError(
            f"{sweep_folder}: expected the folder of a sweep, got one without jobs. Try: cadam3d sweep"
        )
    wanted = _wanted(sweep_folder, names)
    folder = sweep_folder / FOLDER_NAME
    key_table, frontiers = tables.objectives_table(rows), tables.frontier_table(rows)
    standings = tables.standings_table(rows)
    for name, lines in (("objectives", key_table), ("frontiers", frontiers), ("standings", standings)):
        tables.write_csv(folder / f"{name}.csv", lines)
    body = [
        _header(sweep_folder, rows),
        _verdict(rows),
        _tiles(rows),
        _section("Medians of every arm at its standard setting", key_table),
        _without_standard(rows),
        *(_figure(rows, name, folder) for name in wanted),
        _section(f"Against the whole frontier of {words.THEIRS}", standings),
        details("Every setting", tables.as_html(frontiers)) if frontiers else "",
        _failures(rows),
        details(f"All {len(rows)} jobs", tables.as_html(tables.jobs_table(rows), links="job")),
        _commands(sweep_folder),
        _footer(sweep_folder),
    ]
    path = sweep_folder / FILE_NAME
    with replacing(path) as temporary:
        temporary.write_text(page(f"{_name(sweep_folder)} - cadam3d", body, _style()), encoding="utf-8")
    return path


def _wanted(sweep_folder: Path, names: Sequence[str] | None) -> list[str]:
    plan = sweep_folder / PLAN
    if names is None and plan.is_file():
        names = read_json(plan).get("figures")  # what the grid asked for
    for name in names or ():
        if name not in FIGURES:
            raise fail(
                "figures", expected=f"some of {'|'.join(FIGURES)}", got=name, example="figures=[frontier]"
            )
    return list(FIGURES if names is None else names)


def _header(sweep_folder: Path, rows: Sequence[Row]) -> str:
    outcomes = Counter(row.outcome for row in rows)
    chips = [
        outcome_chip(outcome).replace("</span>", f" {count}</span>")
        for outcome, count in outcomes.most_common()
    ]
    for key in (PROMPT, SEED, NOISE):
        values = {row.cell[key] for row in rows if row.cell[key]}
        if values:
            word = "noise level" if key == NOISE else key
            chips.append(f"<span>{len(values)} {word}{'s' if len(values) > 1 else ''}</span>")
    chips.append(f"<span>{len({row.setting for row in rows})} settings</span>")
    return f'<header><h1>{escape(_name(sweep_folder))}</h1><div class="chips">{"".join(chips)}</div></header>'


def _verdict(rows: Sequence[Row]) -> str:
    sentences = words.headline(rows)
    if not sentences:
        return ""
    return f'<div class="card verdict">{"".join(f"<p>{escape(text)}</p>" for text in sentences)}</div>'


def _tiles(rows: Sequence[Row]) -> str:
    """The paper's claim over all levels of noise together."""
    rows = with_noise(rows)
    ours, theirs = standard(rows, words.OURS), standard(rows, words.THEIRS)
    whole = compare(rows, ours, theirs) if ours and theirs else None
    if whole is None:
        return ""
    seeds = "" if whole.psnr_over_seeds is None else f"{whole.psnr_over_seeds:.2f} dB over seeds"
    entries = [
        (
            "Fewer Gaussians",
            f"{whole.reduction.median:.1%}",
            f"{whole.reduction.low:.1%} to {whole.reduction.high:.1%}",
        ),
        ("PSNR", f"{whole.psnr.median:+.2f} dB", seeds or f"{whole.psnr.low:+.2f} to {whole.psnr.high:+.2f}"),
        (
            "SSIM",
            "-" if whole.ssim is None else f"{whole.ssim.median:+.4f}",
            f"{whole.ours.arm} less {whole.theirs.arm}",
        ),
        ("Cells compared", str(whole.cells), f"{whole.early + whole.theirs_early} runs ended early"),
    ]
    return f'<div class="tiles four">{"".join(tile(*entry) for entry in entries)}</div>'


def _figure(rows: Sequence[Row], name: str, folder: Path) -> str:
    draw, title, caption = FIGURES[name]
    with styled():
        figure = draw(rows)
        if figure is None:
            return ""
        svg = inline(write_figure(figure, folder, name))
    return f'<section class="card plot"><h2>{escape(title)}</h2><p>{escape(caption)}</p>{svg}</section>'


def _section(title: str, lines: Sequence[tables.Line]) -> str:
    return f'<h2>{escape(title)}</h2><div class="card">{tables.as_html(lines)}</div>' if lines else ""


def _without_standard(rows: Sequence[Row]) -> str:
    """Whom the key table leaves out: arms of which the sweep has several settings, none of them shipped."""
    arms = [arm for arm in figures.arms_of(rows) if standard(rows, arm) is None]
    if not arms:
        return ""
    verb = "has no standard setting and is" if len(arms) == 1 else "have no standard setting and are"
    return f"<p>{escape(', '.join(arms))} {verb} under Every setting only.</p>"


def _failures(rows: Sequence[Row]) -> str:
    """Every job without a whole asset, and why: an early end is a result, but never a hidden one."""
    items = "".join(
        f'<li><a href="{quote(row.folder.name)}/">{escape(row.folder.name)}</a>: '
        f"{escape(row.outcome.replace('_', ' '))}{escape(f' ({row.message})' if row.message else '')}</li>"
        for row in rows
        if row.outcome not in (COMPLETE, UNFINISHED)
    )
    waiting = sum(row.outcome == UNFINISHED for row in rows)
    note = f"<p>{waiting} jobs are not done; this page shows the others.</p>" if waiting else ""
    if not items and not note:
        return ""
    items = f'<ul class="failures">{items}</ul>' if items else ""
    return f'<h2>Ended early, failed or not done</h2><div class="card">{note}{items}</div>'


def _style() -> str:
    return css() + resources.files("cadam3d.report").joinpath("sweep.css").read_text(encoding="utf-8")


def _commands(sweep_folder: Path) -> str:
    """What to type for the same jobs again: the line of the sweep, and each job's own where that is kept."""
    plan, multirun = sweep_folder / PLAN, sweep_folder / "multirun.yaml"
    if plan.is_file():
        told = read_json(plan)
        lines = [["sweep", *told["line"]]] if told.get("line") else []
        lines += [["train", *job["overrides"]] for job in told["jobs"]]
    elif multirun.is_file():
        told = yaml.safe_load(multirun.read_text(encoding="utf-8")) or {}
        lines = [["sweep", *(((told.get("hydra") or {}).get("overrides") or {}).get("task") or [])]]
    else:
        return ""
    text = "\n".join(" ".join(["cadam3d", *(for_shell(str(word)) for word in line)]) for line in lines)
    return details("The commands" if len(lines) > 1 else "The command", f"<pre>{escape(text)}</pre>")


def for_shell(word: str) -> str:
    """A word as people would type it: in double quotes where those suffice."""
    plain = shlex.quote(word)
    return plain if plain == word or set(word) & set('"$`\\!') else f'"{word}"'


def _name(sweep_folder: Path) -> str:
    return f"Sweep {sweep_folder.resolve().name}"


def _footer(sweep_folder: Path) -> str:
    links = [
        f'<a href="{name}">{name}</a>'
        for name in ("sweep.csv", FOLDER_NAME)
        if (sweep_folder / name).exists()
    ]
    return f"<footer>Made with cadam3d {escape(__version__)}. Beside this page: {', '.join(links)}.</footer>"
