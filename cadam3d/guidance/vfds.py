"""VFDS: compares the velocity that the prior predicts with the velocity of the path itself."""

from dataclasses import dataclass

from cadam3d.guidance.distill import Case, Comparison, GuidedDistillation


@dataclass(frozen=True, kw_only=True)
class VFDS(GuidedDistillation):
    """Vector field distillation sampling (FlowDreamer; paper sec. 3.2).

    With x_t = a x0 + b eps, eps ~ N(0, I),

        G = weight * w(t) * (v_hat(x_t, t, prompt) - v),    v = velocity of the path at (x0, eps),

    which on a rectified flow is v = eps - x0, as published. On a DDPM path v = a eps - b x0. On both,

        v_hat - v = (x0 - x0_hat) / b,

    so that at equal b and an equal predicted clean image the two paths give the same G, which is the G of SDS
    divided by a.
    """

    def compare(self, case: Case) -> Comparison:
        """Subtract the velocity of the pair from the predicted velocity; one guided prediction per view."""
        noise = case.draw_noise()
        guess = case.guess(noise, self.scale)
        velocity = case.prior.noise_path.velocity(case.clean, noise, case.t)
        return Comparison(difference=guess.velocity - velocity, clean=guess.clean)
