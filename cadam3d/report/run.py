"""report.html: one file that shows a run to somebody who was not there. No scripts, nothing fetched."""

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from cadam3d import __version__
from cadam3d.io.atomic import replacing
from cadam3d.report.page import (
    data_url,
    details,
    duration,
    note,
    number,
    outcome_chip,
    page,
    show,
    shown_bytes,
    tile,
)
from cadam3d.report.plot import Band, Bar, Chart, Curve, Point, smooth

FILE_NAME = "report.html"
EMBED_BYTES = 8 << 20  # a larger video is linked, not embedded
SMOOTHING = 15  # shares of a noisy curve's length; the median runs over one of them
COMPONENTS = ("densifier", "guidance", "prior", "rasterizer", "initializer", "device")
SHARE = "share_above_"  # prefix of a share of all Gaussians that a densifier logs
DRAWN = ("kind", "step", "loss", "num_gaussians", "seconds")  # of a step line; its other numbers go below
LABELS = {
    "prompt": "Prompt",
    "negative_prompt": "Negative prompt",
    "outcome": "Outcome",
    "num_gaussians_initial": "Gaussians at the start",
    "initializer_note": "Not from the initializer asked for",
    "num_gaussians": "Gaussians",
    "asset_bytes": "Bytes of asset.ply",
    "asset_mib": "MiB of asset.ply",
    "bytes_per_gaussian": "Bytes per Gaussian",
    "median_scale": "Median scale (world units)",
    "median_opacity": "Median opacity",
    "psnr": "PSNR (dB)",
    "psnr_min": "PSNR of the worst view (dB)",
    "ssim": "SSIM",
    "mode": "Mode of the prior it matches",
    "backend": "Rasterizer that rendered",
    "backend_reason": "Why no faster one",
    "seconds": "Seconds",
    "steps": "Steps done",
    "steps_asked": "Steps asked for",
    "skipped_steps": "Steps skipped (gradient not finite)",
    "dimmed_steps": "Steps that dimmed all colours",
    "seed": "Seed",
}


def write_report(
    folder: Path, *, summary: Mapping[str, Any], metrics: Sequence[Mapping[str, Any]], config_text: str
) -> Path:
    """Write ``report.html`` of the run in ``folder`` and return its path.

    ``summary`` is what ``summary.json`` holds and ``metrics`` the lines of ``metrics.jsonl``; whatever is
    missing from them is left out of the page. ``preview.png`` and, up to 8 MiB, ``turntable.mp4`` are
    embedded if they exist. Everything that a user may have typed is escaped. Raises ``UserError`` if the
    file cannot be written.
    """
    prompt = str(summary.get("prompt") or "Untitled")
    steps = [line for line in metrics if line.get("kind") == "step"]
    refinements = [_flat(line) for line in metrics if line.get("kind") == "refine"]
    end = max((number(line.get("step")) or 0 for line in metrics), default=0) or 1
    body = [
        _header(prompt, summary),
        *(note(warning) for warning in summary.get("warnings") or ()),
        _hero(folder, summary, prompt),
        _charts("While it grew", _growth_charts(steps, refinements, (0, end))),
        _charts("What the densifier saw", _evidence_charts(refinements, (0, end))),
        _facts(summary),
        _refinement_table(refinements),
        _more_numbers(steps, (0, end)),
        details("Configuration", f"<pre>{escape(config_text)}</pre>"),
        _footer(folder),
    ]
    path = folder / FILE_NAME
    with replacing(path) as temporary:
        temporary.write_text(page(f"{prompt} - cadam3d", body), encoding="utf-8")
    return path


def _header(prompt: str, summary: Mapping[str, Any]) -> str:
    chips = [outcome_chip(str(summary.get("outcome", "unknown")))]
    for name in (*COMPONENTS, "seed"):
        if summary.get(name) is not None:
            chips.append(f"<span>{escape(name)} <b>{escape(str(summary[name]))}</b></span>")
    return f'<header><h1>{escape(prompt)}</h1><div class="chips">{"".join(chips)}</div></header>'


def _hero(folder: Path, summary: Mapping[str, Any], prompt: str) -> str:
    tiles = "".join(tile(*entry) for entry in _tiles(summary))
    video, preview = folder / "turntable.mp4", folder / "preview.png"
    left = _video(video) if video.is_file() else _image(preview, prompt)
    below = _image(preview, prompt) if video.is_file() else ""
    below = f'<div class="wide">{below}</div>' if below else ""
    if not left:
        return f'<div class="tiles">{tiles}</div>'
    return f'<div class="hero">{left}<div class="tiles">{tiles}</div></div>{below}'


def _tiles(summary: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Label, value and remark of the numbers that people ask for first."""
    numbers = {name: number(value) for name, value in summary.items()}
    count, initial = numbers.get("num_gaussians"), numbers.get("num_gaussians_initial")
    size, per_gaussian = numbers.get("asset_bytes"), numbers.get("bytes_per_gaussian")
    psnr, ssim = numbers.get("psnr"), numbers.get("ssim")
    done, asked, seconds = numbers.get("steps"), numbers.get("steps_asked"), numbers.get("seconds")
    tiles = []
    if count is not None:
        tiles.append(("Gaussians", f"{count:,.0f}", f"from {initial:,.0f}" if initial is not None else ""))
    if psnr is not None:
        tiles.append(("PSNR", f"{psnr:.2f} dB", f"SSIM {ssim:.3f}" if ssim is not None else "held-out views"))
    if size is not None:
        tiles.append(
            ("asset.ply", shown_bytes(size), f"{per_gaussian:.0f} B per Gaussian" if per_gaussian else "")
        )
    if seconds is not None:
        rate = f"{done / seconds:.1f} steps per second" if done and seconds else ""
        tiles.append(("Time", duration(seconds), rate))
    if done is not None and len(tiles) < 4:
        tiles.append(("Steps", f"{done:,.0f}", f"of {asked:,.0f}" if asked is not None else ""))
    return tiles


def _video(path: Path) -> str:
    is_small = path.stat().st_size <= EMBED_BYTES
    source = data_url(path, "video/mp4") if is_small else path.name
    return (
        f'<figure class="card picture"><video src="{source}" autoplay loop muted playsinline controls>'
        f'<a href="{path.name}">{path.name}</a></video>'
        "<p>One full turn; colour beside depth or alpha</p></figure>"
    )


def _image(path: Path, prompt: str) -> str:
    if not path.is_file():
        return ""
    return (
        f'<figure class="card picture"><img src="{data_url(path, "image/png")}" '
        f'alt="{escape(prompt)}, seen from all around">'
        "<p>From all around; azimuth and elevation in degrees</p></figure>"
    )


def _growth_charts(steps: Sequence[Mapping], refinements: Sequence[Mapping], x_range: Point) -> list[Chart]:
    loss = _points(steps, "loss")
    resets = [(step, count) for step, count in _points(refinements, "reset") if count > 0]
    return [
        Chart(
            title="Gaussians",
            caption="How many there are; ticks on the axis are refinements",
            curves=[Curve("", _counts(steps, refinements), color=1)],
            ticks_at=[step for step, _ in _points(refinements, "after")],
            x_range=x_range,
            zero=True,
        ),
        Chart(
            title="Loss",
            caption="Half the squared norm of the guidance gradient, plus regularizers; logarithmic",
            curves=[
                Curve("logged", loss, color=1, faint=True),
                Curve("running median", smooth(loss, max(len(loss) // SMOOTHING, 1)), color=1),
            ],
            log_y=True,
            x_range=x_range,
        ),
        Chart(
            title="What each refinement did",
            caption="Gaussians cloned and split (up), pruned (down)",
            bars=_refinement_bars(refinements),
            bar_labels=[("cloned", 1), ("split", 2), ("pruned", 4)],
            x_range=x_range,
            zero=True,
        ),
        Chart(
            title="Opacity resets",
            caption="Gaussians whose opacity was lowered",
            bars=[Bar(step, 0, count, 3, f"{count:,.0f} reset at step {step:g}") for step, count in resets],
            x_range=x_range,
            zero=True,
        ),
    ]


def _evidence_charts(refinements: Sequence[Mapping], x_range: Point) -> list[Chart]:
    """What densifiers log about themselves: each chart appears if its numbers do."""
    keys = dict.fromkeys(key for line in refinements for key in line)
    shares = [key for key in keys if key.startswith(SHARE)]
    return [
        _spread(
            refinements,
            "snr",
            "tau_SNR",
            title="Signal to noise of the gradients",
            caption="Drift over noise, all Gaussians, before each refinement",
            x_range=x_range,
        ),
        _spread(
            refinements,
            "gradient",
            "tau_pos",
            title="Screen-space gradients",
            caption="Mean norm of each Gaussian, before each refinement; logarithmic",
            x_range=x_range,
            log_y=True,
        ),
        Chart(
            title="Who may grow",
            caption="Percent of all Gaussians",
            curves=[
                *(
                    Curve(f"above {key[len(SHARE) :]}", _percent(_points(refinements, key)), 1)
                    for key in shares
                ),
                Curve("selected", _selected_percent(refinements), 2),
            ],
            x_range=x_range,
            zero=True,
        ),
        Chart(
            title="Drift",
            caption="Length of the mean gradient; growing starts above the threshold (tau_Q); logarithmic",
            curves=[
                Curve("median", _points(refinements, "drift_median"), 3),
                Curve("threshold", _points(refinements, "drift_threshold"), 4, dashed=True),
            ],
            x_range=x_range,
            log_y=True,
        ),
        Chart(
            title="Median age",
            caption="Steps since birth",
            curves=[Curve("", _points(refinements, "age_median"), 3)],
            x_range=x_range,
            zero=True,
        ),
    ]


def _spread(
    refinements: Sequence[Mapping],
    name: str,
    threshold: str,
    *,
    title: str,
    caption: str,
    x_range: Point,
    log_y=False,
) -> Chart:
    """The median of a logged quantity in the band of its 10 % and 90 % quantiles, and a threshold."""
    low, high = _points(refinements, f"{name}_p10"), _points(refinements, f"{name}_p90")
    return Chart(
        title=title,
        caption=caption,
        curves=[
            Curve("median", _points(refinements, f"{name}_p50"), 1),
            Curve(threshold, _points(refinements, threshold), 4, dashed=True),
        ],
        bands=[Band("10 to 90 %", low, high, 1)],
        x_range=x_range,
        log_y=log_y,
        zero=not log_y,
    )


def _counts(steps: Sequence[Mapping], refinements: Sequence[Mapping]) -> list[Point]:
    """Steps with their counts; a refinement is a vertical jump. A step line counts before its refinement."""
    counts = [(step, 0, count) for step, count in _points(steps, "num_gaussians")]
    counts += [(step, 0, count) for step, count in _points(refinements, "before")]
    counts += [(step, 1, count) for step, count in _points(refinements, "after")]
    return [(step, count) for step, _, count in sorted(counts)]


def _refinement_bars(refinements: Sequence[Mapping]) -> list[Bar]:
    bars = []
    for line in refinements:
        step = number(line.get("step"))
        cloned, split, pruned = (number(line.get(key)) or 0.0 for key in ("cloned", "split", "pruned"))
        if step is not None and cloned + split + pruned > 0:
            hint = f"step {step:g}: {cloned:,.0f} cloned, {split:,.0f} split, {pruned:,.0f} pruned"
            bars.append(Bar(step, 0, cloned, 1, hint))
            bars.append(Bar(step, cloned, cloned + split, 2, hint))
            bars.append(Bar(step, 0, -pruned, 4, hint))
    return bars


def _selected_percent(refinements: Sequence[Mapping]) -> list[Point]:
    before = dict(_points(refinements, "before"))
    selected = _points(refinements, "selected")
    return _percent([(step, count / before[step]) for step, count in selected if before.get(step)])


def _percent(shares: Sequence[Point]) -> list[Point]:
    return [(step, 100 * share) for step, share in shares]


def _charts(title: str, charts: Sequence[Chart]) -> str:
    cards = "".join(
        f'<section class="card"><h3>{escape(chart.title)}</h3><p>{escape(chart.caption)}</p>'
        f"{chart.legend()}{chart.svg()}</section>"
        for chart in charts
        if not chart.is_empty()
    )
    return f'<h2>{escape(title)}</h2><div class="charts">{cards}</div>' if cards else ""


def _facts(summary: Mapping[str, Any]) -> str:
    ordered = [*(key for key in LABELS if key in summary), *(key for key in summary if key not in LABELS)]
    rows = "".join(
        f"<div><dt>{escape(LABELS.get(key) or key.replace('_', ' '))}</dt>"
        f"<dd>{escape(show(summary[key]))}</dd></div>"
        for key in ordered
        if key != "warnings"
    )
    return f'<h2>In numbers</h2><dl class="card facts">{rows}</dl>' if rows else ""


def _refinement_table(refinements: Sequence[Mapping]) -> str:
    if not refinements:
        return ""
    columns = [key for key in dict.fromkeys(key for line in refinements for key in line) if key != "kind"]
    head = "".join(f"<th>{escape(key)}</th>" for key in columns)
    rows = "".join(
        "<tr>" + "".join(f"<td>{escape(show(line.get(key)))}</td>" for key in columns) + "</tr>"
        for line in refinements
    )
    table = f'<div class="scroll"><table class="numbers"><tr>{head}</tr>{rows}</table></div>'
    return details(f"All {len(refinements)} refinements and resets", table)


def _more_numbers(steps: Sequence[Mapping], x_range: Point) -> str:
    """What the guidance and the regularizers logged beyond the loss."""
    keys = [key for key in dict.fromkeys(key for line in steps for key in line) if key not in DRAWN]
    charts = [
        Chart(title=key, caption="", curves=[Curve("", points, color=3)], x_range=x_range)
        for key in keys
        if (points := _points(steps, key))
    ]
    cards = "".join(f"<div><h3>{escape(chart.title)}</h3>{chart.svg()}</div>" for chart in charts)
    return details("Everything else that was logged", f'<div class="charts">{cards}</div>') if cards else ""


def _footer(folder: Path) -> str:
    names = ("asset.ply", "turntable.mp4", "preview.png", "summary.json", "metrics.jsonl", "config.yaml")
    links = [f'<a href="{name}">{name}</a>' for name in names if (folder / name).is_file()]
    beside = f" Beside this page: {', '.join(links)}." if links else ""
    return f"<footer>Made with cadam3d {escape(__version__)}.{beside}</footer>"


def _flat(line: Mapping[str, Any]) -> dict[str, Any]:
    """A refinement line with the densifier's statistics beside the counts, wherever they were."""
    statistics = line.get("statistics")
    rest = {key: value for key, value in line.items() if key != "statistics"}
    return {**rest, **statistics} if isinstance(statistics, Mapping) else rest


def _points(lines: Iterable[Mapping], key: str) -> list[Point]:
    pairs = ((number(line.get("step")), number(line.get(key))) for line in lines)
    return [(step, value) for step, value in pairs if step is not None and value is not None]
