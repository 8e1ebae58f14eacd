"""GCS: compares the prior's trajectory through the render with the trajectory that the prompt would take."""

from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.chart import Chart, Curve
from cadam3d.core.checks import AtLeastZero, Positive, one_of, within
from cadam3d.core.device import upload_together
from cadam3d.core.schedule import Schedule, as_schedule
from cadam3d.guidance.base import GuidanceOutput
from cadam3d.guidance.distill import DIVISORS, RESIDUAL, Case, finite, offset_normal, rms, surrogate
from cadam3d.guidance.trajectory import ROW, UNGUIDED
from cadam3d.guidance.window import WindowedGuidance
from cadam3d.prior.base import Condition, DiffusionPrior
from cadam3d.prior.path import Prediction, per_view

# The smallest distance between e and s.
GAP = 10 * ROW
TERMS = Chart(
    title="Terms of GCS",
    caption="Root mean square of the gradient that each term applies, with its weight, before it is divided "
    "by the number of elements; the pixel constraint acts on pixels, the others on the encoded renders.",
    curves=(
        Curve(key="cc_rms", label="compact consistency"),
        Curve(key="gc_rms", label="conditional guidance"),
        Curve(key="cp_rms", label="pixel constraint"),
    ),
)


@dataclass(frozen=True)
class Levels:
    """Three noise levels, e <= s < t."""

    e: Float[Tensor, "v"]
    s: Float[Tensor, "v"]
    t: Float[Tensor, "v"]


@dataclass(frozen=True)
class Terms:
    """The differences inside the three terms, before their weights."""

    consistency: Float[Tensor, "v c lh lw"]  # CC
    guidance: Float[Tensor, "v c lh lw"]  # GC
    pixels: Float[Tensor, "v h w 3"]  # CP
    clean: Float[Tensor, "v c lh lw"]  # the prior's prediction of the clean image


@dataclass(frozen=True, kw_only=True)
class GCS(WindowedGuidance):
    """Guided consistency sampling (Li et al. 2024, GCS-BEG), without its brightness rule.

    The objective draws t from the window, takes s = t - ``delta`` and draws e from [t - 2 delta, s - 0.01).
    It mixes the render x0 with noise n to x_e = a x0 + b n and follows the prior without a prompt to x_s and
    x_t. From x_t it goes back under the prompt, with classifier-free guidance, to y_s and y_e. Phi(x, p -> q)
    is one DDIM step (DPM-Solver++ of order 1) without a prompt. x0_hat is the predicted clean image without
    the prompt, x0_bar the one under the prompt and guidance:

        CC = || Phi(x_t, t -> e) - Phi(y_s, s -> e) ||^2                 compact consistency
        GC = || x0_hat(x_e, e) - x0_bar(y_e, e) ||^2                     conditional guidance
        CP = || decode(x0_hat(x_e, e)) - decode(x0_bar(y_e, e)) ||^2     pixel constraint
        loss = weight (w_cc CC + w_gc GC + w_cp CP) / D

    Guidance has the conventional form, negative + scale * (positive - negative); the authors' repository
    calls ``weight`` lambda_guidance. The second term of each difference and the networks are constants. The
    slope of the chain of DDIM steps that carries x0 into the first term telescopes to a(e) for CC and to 1
    for GC. CP applies its difference to the pixels of the render directly, without the encoder. If the render
    shows disparity, CP moves the disparity, where the released code moves the colours. The gradients, before
    D, are

        2 weight (a(e) w_cc [CC's difference] + w_gc [GC's])  on x0,    2 weight w_cp [CP's]  on the render.

    There is no w(t), and no factor 1/2 as in the other objectives. D follows ``reduction``; ``mean`` divides
    each part by its own number of elements, latents or pixels. The value of the returned loss is half the
    squared norm of the gradients.

    n is N(0, I) plus ``noise_offset`` * N(0, 1) per channel, an offset that all views share. With
    ``fixed_noise`` every step uses the same n. It is derived from the seed of the guidance's generator, which
    a checkpoint keeps, so a resumed run continues with the same noise. A different number of views gives
    different noise.

    A step makes six predictions, four of them without guidance, and fewer if a weight is 0. CP decodes twice.

    The log holds ``t`` (mean over views), ``guidance_rms`` (of the gradient on x0 before D), ``cc_rms``,
    ``gc_rms``, ``cp_rms`` (of each term's gradient, with its weights), ``residual_rms`` (of x0 minus the last
    predicted clean image) and ``guidance_nonfinite`` (elements replaced by 0).
    """

    scale: AtLeastZero
    weight: Positive
    w_cc: AtLeastZero
    w_gc: AtLeastZero
    w_cp: AtLeastZero
    delta: Annotated[float | Schedule, within(above=GAP, high=0.5)]  # in t
    fixed_noise: bool
    noise_offset: AtLeastZero
    reduction: Annotated[str, one_of(DIVISORS)]

    def __post_init__(self) -> None:
        super().__post_init__()
        is_any = max(self.w_cc, self.w_gc, self.w_cp) > 0
        self.expect(is_any, "w_gc", "a number > 0, since w_cc and w_cp are 0 as well")

    def __call__(
        self,
        rgb: Float[Tensor, "v h w 3"],
        condition: Condition,
        prior: DiffusionPrior,
        step: int,
        generator: torch.Generator,
    ) -> GuidanceOutput:
        """Return the loss of the render ``rgb``, which is in [0, 1] and has a gradient.

        All random numbers come from the CPU ``generator``. Raises ``UserError`` if t_min and t_max
        leave their range at ``step``.
        """
        clean = prior.encode(rgb)
        with torch.no_grad():
            drawn = self.draw_levels(clean, step, generator)
            levels = Levels(*upload_together([drawn.e, drawn.s, drawn.t], clean.device))
            case = Case(clean.detach(), levels.t, condition, prior, step, generator)
            terms = self.terms(case, levels, rgb)
            slope = per_view(prior.noise_path.a(levels.e))
            cc = 2 * self.weight * self.w_cc * slope * terms.consistency
            gc = 2 * self.weight * self.w_gc * terms.guidance
            cp = 2 * self.weight * self.w_cp * terms.pixels
            on_latents, lost_latents = finite(cc + gc)
            on_pixels, lost_pixels = finite(cp)
        divisor = DIVISORS[self.reduction]
        return GuidanceOutput(
            loss=surrogate(clean, on_latents, divisor(clean.shape))
            + surrogate(rgb, on_pixels, divisor(rgb.shape)),
            log={
                "t": levels.t.mean(),
                "guidance_rms": rms(on_latents),
                "cc_rms": rms(cc),
                "gc_rms": rms(gc),
                "cp_rms": rms(cp),
                "residual_rms": rms(clean.detach() - terms.clean),
                "guidance_nonfinite": lost_latents + lost_pixels,
            },
        )

    def charts(self) -> tuple[Chart, ...]:
        """Declare charts of the three terms and of ``residual_rms``."""
        return (TERMS, RESIDUAL)

    def draw_levels(self, clean: Float[Tensor, "v c h w"], step: int, generator: torch.Generator) -> Levels:
        """Draw t from the window, raised to at least delta + 0.001, and s and e below it, on the CPU."""
        delta = as_schedule(self.delta)(step)
        t = self.draw_t(clean, step, generator).clamp_min(delta + ROW)
        s = t - delta
        lowest, highest = (s - delta).clamp_min(0), (s - GAP).clamp_min(ROW)
        e = torch.lerp(lowest, highest, self.uniform(clean, generator)).clamp_min(ROW)
        return Levels(e=e, s=s, t=t)

    def draw_noise(self, case: Case) -> Float[Tensor, "v c h w"]:
        """Return the noise n: the same at every step with ``fixed_noise``, otherwise drawn anew."""
        generator = case.generator
        if self.fixed_noise:
            # Add 1, so that the noise does not repeat the random numbers from which t is drawn.
            generator = torch.Generator().manual_seed((generator.initial_seed() + 1) % 2**63)
        return offset_normal(case.clean, generator, self.noise_offset)

    def terms(self, case: Case, levels: Levels, rgb: Float[Tensor, "v h w 3"]) -> Terms:
        """Follow the prior to t without the prompt and back with it, and return the differences."""
        path, unprompted = case.prior.noise_path, case.condition.unprompted()
        height, width = rgb.shape[1:3]

        def freely(x: Tensor, t: Tensor) -> Prediction:
            return case.prior.predict(x, t, unprompted, UNGUIDED)

        def guided(x: Tensor, t: Tensor) -> Prediction:
            return case.prior.predict(x, t, case.condition, self.scale)

        def step(guess: Prediction, q: Tensor) -> Tensor:
            return path.mix(guess.clean, guess.noise, q)

        at_e = freely(path.mix(case.clean, self.draw_noise(case), levels.e), levels.e)
        at_s = freely(step(at_e, levels.s), levels.s)
        x_t = step(at_s, levels.t)
        back = guided(x_t, levels.t)
        consistency, guidance, pixels = torch.zeros_like(x_t), torch.zeros_like(x_t), torch.zeros_like(rgb)
        target = back.clean
        if self.w_cc > 0:
            straight, bent = freely(x_t, levels.t), freely(step(back, levels.s), levels.s)
            consistency = step(straight, levels.e) - step(bent, levels.e)
        if self.w_gc > 0 or self.w_cp > 0:
            target = guided(step(back, levels.e), levels.e).clean
            guidance = at_e.clean - target
        if self.w_cp > 0:
            now, wanted = (case.prior.decode(x, height, width) for x in (at_e.clean, target))
            pixels = now - wanted
        return Terms(consistency=consistency, guidance=guidance, pixels=pixels, clean=target)
