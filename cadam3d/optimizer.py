"""Adam over the five raw tensors. Moments follow row edits: survivors keep theirs, newborns get zeros."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cadam3d.core.checks import AtLeastZero, BelowOne, Declared, Positive
from cadam3d.core.edit import RowEdit
from cadam3d.core.gaussians import FIELDS, Gaussians
from cadam3d.core.schedule import Schedule, as_schedule

# The tensors as Adam groups them: view-dependent colours are separate, because they learn more slowly.
PARTS = ("means", "sh_dc", "sh_rest", "opacity", "scale", "quat")
MOMENTS = ("exp_avg", "exp_avg_sq")  # as torch names them
# The devices on which torch's kernel for all of Adam is used. It reads and writes 7 arrays where the separate
# operations read and write 18. On a CPU its results differ in the last bit, and Adam takes little of a step.
FUSED = ("cuda",)


@dataclass(frozen=True, kw_only=True)
class AdamSettings(Declared):
    """Learning rates (a number, or a schedule of the step) and constants of Adam (Kingma and Ba 2015)."""

    means_lr: AtLeastZero | Schedule  # world units per step
    sh_dc_lr: AtLeastZero | Schedule
    sh_rest_lr: AtLeastZero | Schedule
    opacity_lr: AtLeastZero | Schedule  # logits per step
    scale_lr: AtLeastZero | Schedule  # natural logs per step
    quat_lr: AtLeastZero | Schedule
    beta1: BelowOne
    beta2: BelowOne
    eps: Positive
    clip_norm: Positive | Schedule | None  # of each part
    clip_unit: Positive  # world units

    def start(self, gaussians: Gaussians) -> "GaussianOptimizer":
        """Return an optimizer that owns a copy of ``gaussians``, with zero moments."""
        return GaussianOptimizer(self, gaussians)

    def learning_rates(self, step: int) -> dict[str, float]:
        """Return the rate of each part at ``step`` (0 is the first)."""
        return {part: float(as_schedule(getattr(self, f"{part}_lr"))(step)) for part in PARTS}

    def largest_norm(self, part: str, step: int) -> float | None:
        """Return the bound of a part at ``step`` (0 is the first); None if gradients are not clipped.

        The gradient of positions is per :attr:`clip_unit`, a length; the others have no unit of length.
        """
        if self.clip_norm is None:
            return None
        bound = float(as_schedule(self.clip_norm)(step))
        return bound / self.clip_unit if part == "means" else bound


class GaussianOptimizer:
    """Mutable owner of the leaf tensors: moves them, and replaces them when rows change."""

    def __init__(self, settings: AdamSettings, gaussians: Gaussians) -> None:
        self.settings = settings
        moments = {kind: gaussians.map(torch.zeros_like) for kind in MOMENTS}
        self._install(gaussians.map(lambda tensor: tensor.detach().clone()), 0, moments)

    @property
    def gaussians(self) -> Gaussians:
        """Return the leaf tensors, whose ``grad`` ``backward()`` fills. :meth:`apply` replaces them."""
        return self._gaussians

    @torch.no_grad()
    def step(self, step: int) -> None:
        """Do one Adam step at the learning rates of ``step`` (0 is the first), then clear the gradients.

        A tensor without a gradient has the gradient zero, so its moments decay like all others. With a
        ``clip_norm``, only Adam sees clipped gradients, because densifiers observe them before this step.
        """
        self._steps += 1
        gradients, rates = self._gradients(step), self.settings.learning_rates(step)
        move = self._move_at_once if self._gaussians.device.type in FUSED else self._move
        move(list(gradients.tensors().values()), rates)
        self.zero_grad()

    def _move(self, gradients: list[Tensor], rates: Mapping[str, float]) -> None:
        """Do the operations of torch's Adam in their order, so that results have the same bits on the CPU.

        Each operation takes all tensors at once, where torch's function would have to be called for each
        learning rate.
        """
        beta1, beta2 = float(self.settings.beta1), float(self.settings.beta2)
        means, squares = (list(self._moments[kind].tensors().values()) for kind in MOMENTS)
        torch._foreach_lerp_(means, gradients, 1 - beta1)
        torch._foreach_mul_(squares, beta2)
        torch._foreach_addcmul_(squares, gradients, gradients, 1 - beta2)
        divisors = torch._foreach_sqrt(squares)
        torch._foreach_div_(divisors, (1 - beta2**self._steps) ** 0.5)
        torch._foreach_add_(divisors, float(self.settings.eps))
        torch._foreach_addcdiv_(
            self._moved(self._gaussians.detach()),
            self._moved(self._moments["exp_avg"]),
            self._moved(Gaussians(**dict(zip(FIELDS, divisors, strict=True)))),
            [-rates[name] / (1 - beta1**self._steps) for name in self._moving],
        )

    def _move_at_once(self, gradients: list[Tensor], rates: Mapping[str, float]) -> None:
        """Move each tensor with one kernel, which reads and writes each array once."""
        beta1, beta2, eps = (float(getattr(self.settings, name)) for name in ("beta1", "beta2", "eps"))
        leaves = self._gaussians.detach()
        means, squares = (self._moments[kind] for kind in MOMENTS)
        # The kernel has one rate for all colours. It uses that of the last part, and the others move further.
        last = "sh_rest" if "sh_rest" in self._moving else "sh_dc"
        of_fields = (rates["means"], rates["scale"], rates["quat"], rates["opacity"], rates[last])
        steps = torch.full((), float(self._steps), device=leaves.device)
        for name, gradient, rate in zip(FIELDS, gradients, of_fields, strict=True):
            torch._fused_adam_(
                [getattr(leaves, name)],
                [gradient.contiguous()],
                [getattr(means, name)],
                [getattr(squares, name)],
                [],
                [steps],
                lr=rate,
                beta1=beta1,
                beta2=beta2,
                weight_decay=0.0,
                eps=eps,
                amsgrad=False,
                maximize=False,
            )
        if rates[last] != rates["sh_dc"]:
            divisors = (squares.sh[:, :1] / (1 - beta2**self._steps)).sqrt() + eps
            further = (rates["sh_dc"] - rates[last]) / (1 - beta1**self._steps)
            leaves.sh[:, :1].addcdiv_(means.sh[:, :1], divisors, value=-further)

    def zero_grad(self) -> None:
        """Clear the gradients without a step."""
        for tensor in self._gaussians.tensors().values():
            tensor.grad = None

    def extreme_gradients(self) -> list[Float[Tensor, ""]]:
        """Return the smallest and the largest element of each gradient, without waiting for the device.

        If a gradient contains NaN, both are NaN. So all of these are finite if and only if all gradients are.
        """
        gradients = [tensor.grad for tensor in self._gaussians.tensors().values()]
        present = [grad for grad in gradients if grad is not None and grad.numel() > 0]
        return [extreme for grad in present for extreme in grad.aminmax()]

    def apply(self, edit: RowEdit) -> None:
        """Replace the rows as ``edit`` says; gradients are dropped."""
        moments = {kind: self._moments[kind].map(edit.carry) for kind in MOMENTS}
        self._install(edit.apply(self._gaussians), self._steps, moments)

    @torch.no_grad()
    def displace(self, offsets: Float[Tensor, "n 3"]) -> None:
        """Add ``offsets`` (world units) to the means; no moment changes."""
        self._gaussians.means.add_(offsets)

    @torch.no_grad()
    def reset_opacity(self, rows: Bool[Tensor, "n"], value: float) -> int:
        """Lower the opacity of ``rows`` to at most ``value`` (paper sec. 4.4), without raising any.

        The opacity moments of exactly these rows become zero, so that old momentum does not undo the reset;
        all other moments stay. Returns the number of lowered opacities.
        """
        logits = self._gaussians.opacity_logits
        ceiling = math.log(value / (1 - value))
        lowered = rows & (logits > ceiling)
        logits.masked_fill_(lowered, ceiling)
        for kind in MOMENTS:
            self._moments[kind].opacity_logits.masked_fill_(rows, 0.0)
        return int(lowered.sum())

    @torch.no_grad()
    def scale_colors(self, factor: float) -> None:
        """Multiply every colour coefficient, the view-independent one too, and zero the moments of colours.

        Coefficients are zero at mid grey, so a factor below 1 moves bright and dark colours towards it
        (GCS-BEG). All other tensors and moments stay.
        """
        self._gaussians.sh.mul_(factor)
        for kind in MOMENTS:
            self._moments[kind].sh.zero_()

    def state_dict(self) -> dict[str, Any]:
        """Return steps done and both moments by part, as numbers and tensors, without the Gaussians."""
        return {
            "steps": self._steps,
            **{
                kind: {name: part.contiguous() for name, part in parts_of(self._moments[kind]).items()}
                for kind in MOMENTS
            },
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue, bit for bit, from the state that :meth:`state_dict` returned for the same Gaussians."""
        moments = {
            kind: joined(
                {name: part.to(self._gaussians.device, copy=True) for name, part in state[kind].items()}
            )
            for kind in MOMENTS
        }
        self._install(self._gaussians.detach(), state["steps"], moments)

    def _gradients(self, step: int) -> Gaussians:
        """Return the gradients as Adam sees them at ``step``."""
        gradients = self._gaussians.map(
            lambda tensor: torch.zeros_like(tensor) if tensor.grad is None else tensor.grad
        )
        clipped = {}
        for name, part in parts_of(gradients).items():
            bound = self.settings.largest_norm(name, step)
            if bound is None:
                return gradients
            # Scaled to the Euclidean norm ``bound`` over all elements if it is longer.
            norm = torch.linalg.vector_norm(part)
            clipped[name] = part * (bound / norm.clamp_min(bound))
        return joined(clipped)

    def _moved(self, gaussians: Gaussians) -> list[Tensor]:
        """Return views of the parts that have any elements, each of which has its own learning rate."""
        parts = parts_of(gaussians)
        return [parts[name] for name in self._moving]

    def _install(self, gaussians: Gaussians, steps: int, moments: Mapping[str, Gaussians]) -> None:
        """Make ``gaussians`` the leaf tensors, with their moments after ``steps`` steps."""
        self._gaussians = gaussians.map(lambda tensor: tensor.detach().contiguous().requires_grad_())
        self._steps = steps
        self._moments = {kind: moment.map(Tensor.contiguous) for kind, moment in moments.items()}
        # Without higher harmonics, the part of the others is empty.
        parts = parts_of(self._gaussians)
        self._moving = [name for name in PARTS if parts[name].shape[1:].numel() > 0]


def parts_of(gaussians: Gaussians) -> dict[str, Tensor]:
    """Return the tensors as Adam groups them, in the order of ``PARTS``, as views without copies."""
    tensors = (
        gaussians.means,
        gaussians.sh[:, :1],
        gaussians.sh[:, 1:],
        gaussians.opacity_logits,
        gaussians.log_scales,
        gaussians.quats,
    )
    return dict(zip(PARTS, tensors, strict=True))


def joined(parts: Mapping[str, Tensor]) -> Gaussians:
    """Return the tensors that :func:`parts_of` has separated."""
    return Gaussians(
        means=parts["means"],
        log_scales=parts["scale"],
        quats=parts["quat"],
        opacity_logits=parts["opacity"],
        sh=torch.cat([parts["sh_dc"], parts["sh_rest"]], dim=1),
    )
