"""SDS: compares the noise that the prior predicts with the noise that was added."""

from dataclasses import dataclass

from cadam3d.guidance.distill import Case, Comparison, GuidedDistillation


@dataclass(frozen=True, kw_only=True)
class SDS(GuidedDistillation):
    """Score distillation sampling (Poole et al. 2023, eq. 3; GaussianDreamer's objective).

    With x_t = a x0 + b eps, eps ~ N(0, I), on any path,

        G = weight * w(t) * (eps_hat(x_t, t, prompt) - eps)
          = weight * w(t) / gamma(t) * (x0 - x0_hat)                 (paper eq. 4)

    where eps_hat is under classifier-free guidance in the conventional form. GaussianDreamer defines its
    scale of 100 by eps_y + 100 (eps_y - eps_n), which corresponds to ``scale=101`` here.
    """

    def compare(self, case: Case) -> Comparison:
        """Subtract the added noise from the predicted noise; one guided prediction per view."""
        noise = case.draw_noise()
        guess = case.guess(noise, self.scale)
        return Comparison(difference=guess.noise - noise, clean=guess.clean)
