"""Metric: numbers about a finished asset. Measurand: what is measured. Measurement: what a metric returns."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from cadam3d.core.checks import Declared
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.number import Number
from cadam3d.core.rendering import RenderFn, Truth


@dataclass(frozen=True, kw_only=True)
class Measurand:
    """An asset with everything that a metric may look at."""

    gaussians: Gaussians
    render: RenderFn  # shows these Gaussians
    prompt: str  # the text that the asset was made for
    # The true object; None if it is not known. If the asset may face any side, ``truth.turned()`` faces as
    # the asset does.
    truth: Truth | None = None
    asset: Path | None = None  # the file with these Gaussians; None if none was written


@dataclass(frozen=True)
class Measurement:
    """Numbers that one metric has measured of one asset.

    ``numbers`` become entries of ``summary.json`` and ``eval.json``. ``details`` says, for some of them by
    name, how the number came about: protocol, model, values of the single views and so on. It must consist
    of what JSON can hold, and both files keep it under ``measurements``.
    """

    numbers: dict[str, float]
    details: dict[str, dict[str, Any]] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()  # for the user, each with what to do about it


class Metric(Declared, ABC):
    """Interface of all metrics. A subclass is a frozen dataclass of its settings."""

    # What the metric can measure. Tables, reports and ``select=`` read this from the files of a run.
    numbers: ClassVar[tuple[Number, ...]] = ()

    def prepare(self) -> None:
        """Raise ``UserError`` if something is missing that the metric needs, such as the files of a model.

        This is called before a run begins and before assets are measured, so that nothing is done in vain.
        Files on a hub are downloaded now.
        """

    @abstractmethod
    def measure(self, measurand: Measurand) -> Measurement:
        """Return named numbers. Those that need something that is not known are left out."""

    def measure_start(self, measurand: Measurand) -> dict[str, float]:
        """Return named numbers about the Gaussians at the start of the run, as a baseline; {} by default.

        This is called only if the run names a truth. ``measurand`` has these Gaussians, and the truth of
        :meth:`measure` with the turn of the asset. It has no file.
        """
        return {}
