"""ShapesPrior: an exact diffusion model of a procedural world, without weights and with a known truth."""

from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.core.checks import fail
from cadam3d.core.mesh.distance import true_surfaces
from cadam3d.core.rendering import Triangles
from cadam3d.prior.exact import Census, ExactPrior, ExactScene, stored_census
from cadam3d.prior.shapes.grammar import EXAMPLE
from cadam3d.prior.shapes.objects import known_objects, known_primitives
from cadam3d.prior.shapes.scene import Scene, build, signed_distance
from cadam3d.prior.shapes.tracing import TracerName, find_tracer, tracer_for


@dataclass(frozen=True)
class ShapesScene(ExactScene):
    """A scene of procedural shapes, whose modes differ in colour only."""

    scene: Scene
    tracer: str  # of TRACERS

    @property
    def log_weights(self) -> Float[Tensor, "m"]:
        """Return the logarithms of the modes' weights."""
        return self.scene.log_weights

    def draw(
        self, cameras: Cameras, background: Float[Tensor, "v 3"], samples: int
    ) -> tuple[Float[Tensor, "v m 3 h w"], Float[Tensor, "v 1 h w"]]:
        """Trace the parts once, and paint them in the colours of each mode."""
        scene = self.scene.to(cameras.intrinsics.device, cameras.intrinsics.dtype)
        layers = tracer_for(self.tracer, cameras).trace(scene, cameras, samples)
        return layers.images(scene.albedo, background), layers.alpha[:, None]

    def surfaces(self) -> list[Triangles]:
        """Return the outer surface, which all modes share."""
        scene = self.scene.to(torch.device("cpu"), torch.float64)
        return true_surfaces(lambda points: signed_distance(scene, points)[None])

    def census(self, size: int) -> Census:
        """Return the census of all objects of this world."""
        return shapes_census(size, self.tracer)


@dataclass(frozen=True, kw_only=True)
class ShapesPrior(ExactPrior):
    """A Gaussian mixture over images of procedural shapes, one mode per choice of open colours."""

    tracer: TracerName

    def scene(self, prompt: str, key: str = "prompt") -> ShapesScene:
        """Parse the prompt in the setting ``key``.

        Raises ``UserError`` for an empty prompt, for words that the grammar does not know, and if a native
        tracer is wanted and cannot be compiled. It is compiled here, and not in the first step.
        """
        return shapes_scene(prompt, key, self.tracer)


def shapes_scene(prompt: str, key: str, tracer: str) -> ShapesScene:
    """Return the scene of the prompt in the setting ``key``; raises as :meth:`ShapesPrior.scene` does."""
    if not prompt.strip():
        raise fail(key, expected="an object", got=prompt, example=f'{key}="{EXAMPLE}"')
    scene = build(prompt, key)
    find_tracer(tracer)
    return ShapesScene(scene, tracer)


@lru_cache(maxsize=4)
def shapes_census(size: int, tracer: str) -> Census:
    """Return the moments over all objects of the world, a few views of each and all modes, equally likely."""
    names = (*known_primitives(), *known_objects())
    scenes = (ShapesScene(build(name), tracer) for name in names)
    return stored_census(f"shapes {find_tracer(tracer).identity}", scenes, size)
