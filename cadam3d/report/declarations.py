"""charts.json: the charts that the densifier and the objective of a run declare, kept as data with the run.

The report of a sweep reads them from the folders of its jobs. If the file is missing,
damaged or written by another version, there are no declared charts; that is not an error.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from cadam3d.core.chart import Chart, Curve, Level
from cadam3d.core.errors import UserError
from cadam3d.io.jsonl import is_number, read_json, write_json
from cadam3d.io.run_folder import CHARTS

# The charts that every run has, whatever it declares.
GAUSSIANS = Chart(title="Gaussians", caption="The number of Gaussians.", curves=(Curve(key="num_gaussians"),))
LOSS = Chart(
    title="Loss",
    caption="Half the squared norm of the guidance gradient plus regularizers.",
    curves=(Curve(key="loss"),),
    log_y=True,
)


def write_declarations(folder: Path, charts: Sequence[Chart]) -> None:
    """Write ``charts.json`` into the folder of a run. Raises ``UserError`` if that is impossible."""
    write_json(folder / CHARTS, [asdict(chart) for chart in charts])


def read_declarations(folder: Path) -> tuple[Chart, ...]:
    """Return the charts that the run in ``folder`` declared; those that cannot be read are left out."""
    try:
        content = read_json(folder / CHARTS)
    except UserError:
        return ()
    found = []
    for entry in content if isinstance(content, list) else []:
        try:
            found.append(_chart(entry))
        except (AttributeError, LookupError, TypeError, ValueError):
            continue
    return tuple(found)


def _chart(entry: Mapping[str, Any]) -> Chart:
    """Return the chart that plain data describe. Raises a built-in exception if they describe none."""
    band, score = entry.get("band"), _text(entry.get("score", ""))
    # The score becomes the name of files.
    if score and not score.isidentifier():
        raise ValueError(f"expected the name of a score, got {score!r}")
    return Chart(
        title=_text(entry["title"]),
        caption=_text(entry["caption"]),
        curves=tuple(
            Curve(
                key=_text(curve["key"]),
                label=_text(curve.get("label", "")),
                is_threshold=bool(curve.get("is_threshold")),
            )
            for curve in entry["curves"]
        ),
        band=None if band is None else (_text(band[0]), _text(band[1])),
        band_label=_text(entry.get("band_label", "")),
        log_y=bool(entry.get("log_y")),
        percent=bool(entry.get("percent")),
        score=score,
        levels=tuple(
            Level(label=_text(level["label"]), value=_number(level["value"]))
            for level in entry.get("levels", ())
        ),
    )


def _number(value: object) -> float:
    if not is_number(value):
        raise TypeError(f"expected a number, got {value!r}")
    return value


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError(f"expected text, got {value!r}")
    return value
