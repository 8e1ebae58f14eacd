"""WorldPrior: real objects where a prompt names one, and procedural shapes for every other prompt."""

from dataclasses import dataclass, fields

from cadam3d.core.errors import UserError
from cadam3d.prior.exact import ExactEmbedding, ExactPrior, ExactScene
from cadam3d.prior.objects.catalog import read_catalog
from cadam3d.prior.objects.prior import ObjectsPrior
from cadam3d.prior.shapes.prior import ShapesPrior
from cadam3d.prior.shapes.tracing import TracerName


@dataclass(frozen=True, kw_only=True)
class WorldPrior(ExactPrior):
    """An exact diffusion model of both worlds."""

    folder: str | None  # of objects; None: those that come with cadam3d
    tracer: TracerName  # of shapes

    def embed(self, prompt: str, negative: str) -> ExactEmbedding:
        """Read both prompts in the world of the first one, and say which objects it names."""
        return self.chosen(prompt).embed(prompt, negative)

    def scene(self, prompt: str, key: str = "prompt") -> ExactScene:
        """Return the objects or the shapes that the prompt in the setting ``key`` names.

        Raises ``UserError`` for a prompt that neither world has.
        """
        return self.chosen(prompt).scene(prompt, key)

    def chosen(self, prompt: str) -> ExactPrior:
        """Return the prior of the world that has a prompt: the objects if they do, and else the shapes.

        Raises ``UserError`` if neither does.
        """
        catalog = read_catalog(self.folder)
        if catalog.matching(prompt):
            return self._as(ObjectsPrior)
        shapes = self._as(ShapesPrior)
        try:
            shapes.scene(prompt)
        except UserError as error:
            if near := catalog.nearest(prompt):
                raise UserError(f'{error} Or the object alone: prompt="a {near}"') from error
            raise
        return shapes

    def _as(self, kind: type[ExactPrior]) -> ExactPrior:
        return kind(**{field.name: getattr(self, field.name) for field in fields(kind)})
