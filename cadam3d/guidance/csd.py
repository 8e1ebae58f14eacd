"""CSD: follows only the difference that the prompt makes, which classifier-free guidance amplifies."""

from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor

from cadam3d.core.checks import Share
from cadam3d.core.schedule import Schedule, as_schedule
from cadam3d.guidance.distill import Case, Comparison, Distillation
from cadam3d.guidance.trajectory import UNGUIDED

# Guidance scales at which a prediction depends on the prompt alone, or on the negative prompt alone.
PROMPT, NEGATIVE = 1.0, 0.0


@dataclass(frozen=True, kw_only=True)
class CSD(Distillation):
    """Classifier score distillation (Yu et al. 2024, "Text-to-3D with classifier score distillation").

    With x_t = a x0 + b eps, eps ~ N(0, I), r the ``empty_share`` and n the negative prompt,

        G = weight * w(t) * (eps(x_t, t, prompt) - (1 - r) eps(x_t, t, n) - r eps(x_t, t, no prompt)),

    the part of SDS that grows with the guidance scale: at r = 0 it is SDS at scale s + 1 minus SDS at scale
    1, divided by s. CSD has no guidance scale, since that would only be another weight. A schedule for r
    anneals the negative prompt, as the authors' recipes do.

    Each step makes two predictions of a single branch, and a third if 0 < r < 1.
    """

    empty_share: Share | Schedule

    def compare(self, case: Case) -> Comparison:
        """Subtract the noise of the reference prediction from the noise predicted under the prompt."""
        noise = case.draw_noise()
        guess = case.guess(noise, PROMPT)
        return Comparison(difference=guess.noise - self._reference(case, noise), clean=guess.clean)

    def _reference(self, case: Case, noise: Float[Tensor, "v c h w"]) -> Float[Tensor, "v c h w"]:
        share = as_schedule(self.empty_share)(case.step)
        if share == 0:
            return case.guess(noise, NEGATIVE).noise
        empty = replace(case, condition=case.condition.unprompted()).guess(noise, UNGUIDED).noise
        return empty if share == 1 else (1 - share) * case.guess(noise, NEGATIVE).noise + share * empty
