"""charts.json: the charts that the densifier and the objective of a run declare, kept as data with the run.

The report of a sweep reads them from the folders of its jobs. If the file is missing,
damaged or written by another version, there are no declared charts; that is not an error.
"""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from cadam3d.core.chart import Chart, Curve
from cadam3d.core.errors import UserError
from cadam3d.io.jsonl import read_json, write_json
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
    """Return the charts that the run in ``folder`` declared; none if the file cannot be read."""
    from pydantic import TypeAdapter  # takes a tenth of a second to load

    try:
        charts = TypeAdapter(tuple[Chart, ...]).validate_python(read_json(folder / CHARTS))
    except (UserError, ValueError):
        return ()
    # A score becomes the name of files.
    return tuple(chart for chart in charts if not chart.score or chart.score.isidentifier())
