"""TruthSource: where the true object of a run comes from, with which its asset is compared."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, ClassVar

from cadam3d.core.checks import Declared, fail, one_of, whole
from cadam3d.core.errors import UserError
from cadam3d.core.rendering import Truth
from cadam3d.io.frames import UPS
from cadam3d.prior.base import DiffusionPrior
from cadam3d.prior.exact import Samples
from cadam3d.prior.objects.catalog import read_catalog
from cadam3d.prior.objects.scene import MeshScene, read_object
from cadam3d.prior.shapes.prior import shapes_scene
from cadam3d.prior.shapes.tracing import TracerName, find_tracer

Turns = Annotated[int, whole(low=2, high=72)]


class TruthSource(Declared, ABC):
    """Names the true object of a prompt. A subclass is a frozen dataclass of its settings."""

    # Whether the Gaussians at the start of a run are measured too, as a baseline for those at its end.
    measures_start: ClassVar[bool] = False

    @abstractmethod
    def of(self, prompt: str, prior: DiffusionPrior) -> Truth | None:
        """Return the true object of ``prompt`` for a run with ``prior``, or None if there is none.

        This is called before training, so it should not compute images yet. Raises ``UserError`` for a prompt
        that the source cannot read.
        """


@dataclass(frozen=True, kw_only=True)
class PriorTruth(TruthSource):
    """The truth of the prior itself, if the prior knows one."""

    def of(self, prompt: str, prior: DiffusionPrior) -> Truth | None:
        """Return the truth of ``prior``, or None if it knows none."""
        return prior.truth(prompt)


@dataclass(frozen=True, kw_only=True)
class NoTruth(TruthSource):
    """No truth, so nothing is compared."""

    def of(self, prompt: str, prior: DiffusionPrior) -> Truth | None:
        """Return None."""
        return None


@dataclass(frozen=True, kw_only=True)
class MeshTruth(TruthSource):
    """A textured mesh from a file, upright and as large as every object of ``prior=objects``."""

    measures_start: ClassVar[bool] = True

    path: str | None
    up: Annotated[str, one_of(UPS)]  # the up axis of the file
    samples_per_pixel: Samples
    turns: Turns | None  # None: the front of the asset is known

    def of(self, prompt: str, prior: DiffusionPrior) -> Truth:
        """Return the mesh, whatever the prompt is. Raises ``UserError`` if it cannot be read."""
        mesh = read_object(self.path or "", "truth.path", self.up)
        return MeshScene([mesh], read_catalog(None).census).truth(self.samples_per_pixel, self.turns)


@dataclass(frozen=True, kw_only=True)
class ShapesTruth(TruthSource):
    """The scene that the embedded world has for a prompt, compared at the best of ``turns`` turns.

    With the same ``samples_per_pixel``, its images and its shape equal those that ``prior=shapes`` knows.
    """

    measures_start: ClassVar[bool] = True

    samples_per_pixel: Samples
    turns: Turns | None  # None: the front of the asset is known
    tracer: TracerName

    def of(self, prompt: str, prior: DiffusionPrior) -> Truth:
        """Return the scene of ``prompt``.

        Raises ``UserError`` if the embedded world has none, or if a native tracer is wanted and cannot be
        compiled.
        """
        find_tracer(self.tracer, "truth.tracer")
        try:
            scene = shapes_scene(prompt, "prompt", self.tracer)
        except UserError as error:
            expected = "a prompt of the embedded world, which truth=shapes draws"
            raise fail("truth", expected=expected, got=prompt, example="truth=prior") from error
        return scene.truth(self.samples_per_pixel, self.turns)
