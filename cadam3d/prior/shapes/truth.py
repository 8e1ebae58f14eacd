"""truth=shapes: the exact images and the shape of a scene of the embedded world, for a run on any prior."""

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.core.checks import require_choice, require_whole
from cadam3d.core.errors import UserError
from cadam3d.core.render import Truth
from cadam3d.prior.base import DiffusionPrior
from cadam3d.prior.shapes.scene import Scene, build, signed_distance
from cadam3d.prior.shapes.trace_cache import shared_trace
from cadam3d.prior.shapes.tracer import Layers
from cadam3d.prior.shapes.tracers import TRACERS, find_tracer
from cadam3d.prior.truth import TruthSource

MOST_TURNS = 72


@dataclass(frozen=True, kw_only=True)
class ShapesTruth(TruthSource):
    """The scene that the embedded world has for a prompt, compared at the best of ``turns`` turns.

    With the same ``samples_per_pixel``, its images and its shape equal those that ``prior=shapes`` knows.
    """

    measures_start: ClassVar[bool] = True

    samples_per_pixel: int  # along each axis
    turns: int | None  # None: the front of the asset is known
    tracer: str  # of TRACERS

    def __post_init__(self) -> None:
        require_whole("truth.samples_per_pixel", self.samples_per_pixel, low=1, high=8, example=2)
        if self.turns is not None:
            require_whole("truth.turns", self.turns, low=2, high=MOST_TURNS, example=24)
        require_choice("truth.tracer", self.tracer, TRACERS)

    def of(self, prompt: str, prior: DiffusionPrior) -> Truth:
        """Return the scene of ``prompt``.

        Raises ``UserError`` if the embedded world has none, or if a native tracer is wanted and cannot be
        compiled.
        """
        find_tracer(self.tracer, "truth.tracer")
        try:
            scene = build(prompt)
        except UserError as error:
            reason = str(error).removeprefix("prompt: ").partition(" Try: ")[0].removesuffix(".")
            raise UserError(
                "truth: expected a prompt of the embedded world, which truth=shapes draws, got another one "
                f"({reason}). Try: truth=prior"
            ) from error
        return true_scene(scene, self.samples_per_pixel, self.turns, self.tracer)


def true_scene(scene: Scene, samples_per_pixel: int, turns: int | None = None, tracer: str = "auto") -> Truth:
    """Return the images, the outlines and the shape of a scene, whose modes differ in colour only."""

    def layers(cameras: Cameras) -> tuple[Layers, Scene]:
        sized = scene.to(cameras.intrinsics.device, cameras.intrinsics.dtype)
        return shared_trace(sized, cameras, samples_per_pixel, tracer), sized

    def images(cameras: Cameras, background: Tensor) -> Tensor:
        traced, sized = layers(cameras)
        return traced.images(sized.albedo, background).permute(1, 0, 3, 4, 2)

    def alpha(cameras: Cameras) -> Tensor:
        traced, sized = layers(cameras)
        return traced.alpha.expand(len(sized.albedo), *traced.alpha.shape)

    def distance(points: Tensor) -> Tensor:
        return signed_distance(scene.to(points.device, points.dtype), points)[None]

    return Truth(images=images, distance=distance, alpha=alpha, turns=turns)
