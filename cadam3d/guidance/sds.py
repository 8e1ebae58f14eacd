"""SDS: would the prior have removed the noise that we know we added?"""

from dataclasses import dataclass

from cadam3d.guidance.distill import Case, Comparison, GuidedDistillation


@dataclass(frozen=True, kw_only=True)
class SDS(GuidedDistillation):
    """Score distillation sampling (Poole et al. 2023, eq. 3; GaussianDreamer's objective).

    With x_t = a x0 + b eps, eps ~ N(0, I), on any path,

        G = weight * w(t) * (eps_hat(x_t, t, prompt) - eps)
          = weight * w(t) / gamma(t) * (x0 - x0_hat)                 (paper eq. 4)

    where eps_hat is under classifier-free guidance in the conventional form. GaussianDreamer's own scale of
    100 counts from the prompt, eps_y + 100 (eps_y - eps_n), which is 101 here.
    """

    def compare(self, case: Case) -> Comparison:
        """Predicted noise minus added noise. One guided prediction per view."""
        noise = case.draw_noise()
        guess = case.guess(noise, self.scale)
        return Comparison(difference=guess.noise - noise, clean=guess.clean)
