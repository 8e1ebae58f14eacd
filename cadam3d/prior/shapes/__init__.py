"""prior=shapes: an exact diffusion model of a small procedural world."""

from cadam3d.prior.shapes.objects import known_objects, known_primitives
from cadam3d.prior.shapes.prior import ShapesPrior
from cadam3d.prior.shapes.words import known_words

__all__ = ["ShapesPrior", "known_objects", "known_primitives", "known_words"]
