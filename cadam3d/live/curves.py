"""Curves: the numbers of ``metrics.jsonl`` over the steps, read piece by piece while a run writes them."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cadam3d.core.chart import Chart
from cadam3d.core.errors import UserError
from cadam3d.io.declarations import GAUSSIANS, LOSS
from cadam3d.io.jsonl import is_number, parse_json
from cadam3d.io.reading import open_contained, signature
from cadam3d.io.records import is_metrics
from cadam3d.io.run_folder import METRICS

# Limits of what is kept in memory and of what is sent to a page.
MOST_KEYS, MOST_POINTS, MOST_SENT = 200, 4096, 500
MOST_CHARTS, MOST_CURVES = 20, 8
LARGEST_PIECE = 1 << 24  # bytes that are read at once; what remains is read at the next call
LONGEST_LINE = 1 << 20  # bytes
Points = list[tuple[int, float]]  # steps, ascending, and values


@dataclass
class Curves:
    """The curves of one run. A run that is resumed replaces its log, which is then read from the start."""

    run: Path
    version: int = field(default=0, init=False)  # increases with every change
    _points: dict[str, Points] = field(default_factory=dict, init=False)
    _read: tuple[int, int, int] = field(default=(0, 0, 0), init=False)  # device, file, bytes
    _rest: bytes = field(default=b"", init=False)  # of a line that is not complete

    def update(self) -> None:
        """Read what was written since the last call. A log that is missing or unreadable has no lines."""
        try:
            with open_contained(self.run, METRICS) as file:
                device, number, size, _ = signature(file)
                if (device, number) != self._read[:2] or size < self._read[2]:
                    self._points, self._read, self._rest = {}, (device, number, 0), b""
                    self.version += 1
                file.seek(self._read[2])
                piece = file.read(LARGEST_PIECE)
        except (OSError, UserError, ValueError):
            return
        if not piece:
            return
        self._read = (device, number, self._read[2] + len(piece))
        *lines, rest = (self._rest + piece).split(b"\n")
        self._rest = rest if len(rest) < LONGEST_LINE else b""
        self.version += 1
        for line in lines:
            self._add(line)

    def last(self, key: str) -> float | None:
        """Return the newest value of a curve; None if it has none."""
        points = self._points.get(key)
        return points[-1][1] if points else None

    @property
    def last_step(self) -> int:
        """Return the newest step of the log."""
        return max((points[-1][0] for points in self._points.values()), default=0)

    def drawn(self, charts: Iterable[Chart]) -> list[dict[str, Any]]:
        """Return the common charts and ``charts``, with their numbers so far, as plain data."""
        found = []
        for chart in (GAUSSIANS, LOSS, *charts)[:MOST_CHARTS]:
            facts = {name: getattr(chart, name) for name in ("title", "caption", "log_y", "percent")}
            bounds = [{"key": key, "points": self._sent(key)} for key in chart.band or ()]
            curves = [
                {**vars(curve), "points": self._sent(curve.key)} for curve in chart.curves[:MOST_CURVES]
            ]
            found.append({**facts, "curves": curves, "band": bounds, "band_label": chart.band_label})
        return found

    def _sent(self, key: str) -> Points:
        """Return a curve with few enough points for a chart, the last one included."""
        points = self._points.get(key, [])
        every = -(-len(points) // MOST_SENT) or 1
        return points[:-1:every] + points[-1:]

    def _add(self, text: bytes) -> None:
        try:
            line = parse_json(text)
        except (ValueError, RecursionError):
            return
        if not isinstance(line, dict) or not is_metrics(line):
            return
        statistics = line.get("statistics", {})
        if line["kind"] == "refine":
            statistics = {**statistics, "num_gaussians": line.get("after")}
            line = {"step": line["step"]}
        for key, value in {**line, **statistics}.items():
            if key not in ("kind", "step", "statistics") and is_number(value):
                self._append(key, line["step"], value)

    def _append(self, key: str, step: int, value: float) -> None:
        if key not in self._points and len(self._points) >= MOST_KEYS:
            return
        points = self._points.setdefault(key, [])
        # A step counts the Gaussians before its refinement, whose line comes first.
        if points and points[-1][0] >= step:
            return
        points.append((step, value))
        # Older points become sparser, and the length stays bounded.
        if len(points) > MOST_POINTS:
            del points[1:-1:2]
