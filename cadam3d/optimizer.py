"""Adam over the five raw tensors. Moments follow row edits: survivors keep theirs, newborns get zeros."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.optim.adam import adam

from cadam3d.core.checks import require, require_range
from cadam3d.core.edit import RowEdit
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.schedule import Schedule, as_schedule, require_scheduled, settled_at

# The tensors as Adam groups them: view-dependent colours are separate, because they learn more slowly.
PARTS = ("means", "sh_dc", "sh_rest", "opacity", "scale", "quat")
COLOR_PARTS = ("sh_dc", "sh_rest")
MOMENTS = ("exp_avg", "exp_avg_sq")  # as torch names them


@dataclass(frozen=True, kw_only=True)
class AdamSettings:
    """Learning rates (a number, or a schedule of the step) and constants of Adam (Kingma and Ba 2015)."""

    means_lr: float | Schedule  # >= 0, world units per step
    sh_dc_lr: float | Schedule  # >= 0
    sh_rest_lr: float | Schedule  # >= 0
    opacity_lr: float | Schedule  # >= 0, logits per step
    scale_lr: float | Schedule  # >= 0, natural logs per step
    quat_lr: float | Schedule  # >= 0
    beta1: float  # in [0, 1)
    beta2: float  # in [0, 1)
    eps: float  # > 0
    clip_norm: float | Schedule | None  # > 0, of each part
    clip_unit: float  # > 0, world units

    def __post_init__(self) -> None:
        for part in PARTS:
            require_scheduled(f"optimizer.{part}_lr", getattr(self, f"{part}_lr"), low=0, example=0.005)
        require_range("optimizer.beta1", self.beta1, low=0, below=1, example=0.9)
        require_range("optimizer.beta2", self.beta2, low=0, below=1, example=0.999)
        require_range("optimizer.eps", self.eps, above=0, example=1e-15)
        if self.clip_norm is not None:
            require_scheduled("optimizer.clip_norm", self.clip_norm, above=0, example="null")
        require_range("optimizer.clip_unit", self.clip_unit, above=0, example=1.0)

    def start(self, gaussians: Gaussians) -> "GaussianOptimizer":
        """Return an optimizer that owns a copy of ``gaussians``, with zero moments."""
        return GaussianOptimizer(self, gaussians)

    def learning_rates(self, step: int) -> dict[str, float]:
        """Return the rate of each part at ``step`` (0 is the first)."""
        return {part: float(as_schedule(getattr(self, f"{part}_lr"))(step)) for part in PARTS}

    def settled_at(self) -> int:
        """Return the first step from which no learning rate changes; 0 if all are constant."""
        return max(settled_at(getattr(self, f"{part}_lr")) for part in PARTS)

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
        moments = {kind: parts_of(gaussians.map(torch.zeros_like)) for kind in MOMENTS}
        self._install(gaussians.map(lambda tensor: tensor.detach().clone()), {"steps": 0, **moments})

    @property
    def gaussians(self) -> Gaussians:
        """Return the leaf tensors, whose ``grad`` ``backward()`` fills. :meth:`apply` replaces them."""
        return self._gaussians

    def step(self, step: int) -> None:
        """Do one Adam step at the learning rates of ``step`` (0 is the first), then clear the gradients.

        A tensor without a gradient has the gradient zero, so its moments decay like all others. With a
        ``clip_norm``, only Adam sees clipped gradients, because densifiers observe them before this step.
        """
        rates = self.settings.learning_rates(step)
        gradients = self._gaussians.map(
            lambda tensor: torch.zeros_like(tensor) if tensor.grad is None else tensor.grad
        )
        for name, gradient in parts_of(gradients).items():
            bound = self.settings.largest_norm(name, step)
            self._move(name, gradient if bound is None else _clipped(gradient, bound), rates[name])
        self.zero_grad()

    def zero_grad(self) -> None:
        """Clear the gradients without a step."""
        for tensor in self._gaussians.tensors().values():
            tensor.grad = None

    def finite_gradients(self) -> bool:
        """Return whether no gradient contains NaN or infinity. Waits for the device once."""
        gradients = [tensor.grad for tensor in self._gaussians.tensors().values() if tensor.grad is not None]
        return not gradients or bool(torch.stack([grad.isfinite().all() for grad in gradients]).all())

    def apply(self, edit: RowEdit) -> None:
        """Replace the rows as ``edit`` says; gradients are dropped."""
        moments = self.state_dict()
        for kind in MOMENTS:
            moments[kind] = {name: edit.carry(rows) for name, rows in moments[kind].items()}
        self._install(edit.apply(self._gaussians), moments)

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
            self._moments[kind]["opacity"].masked_fill_(rows, 0.0)
        return int(lowered.sum())

    @torch.no_grad()
    def scale_colors(self, factor: float) -> None:
        """Multiply every colour coefficient, the view-independent one too, and zero the moments of colours.

        Coefficients are zero at mid grey, so a factor below 1 moves bright and dark colours towards it
        (GCS-BEG). All other tensors and moments stay.
        """
        self._gaussians.sh.mul_(factor)
        for part in COLOR_PARTS:
            for kind in MOMENTS:
                self._moments[kind][part].zero_()

    def state_dict(self) -> dict[str, Any]:
        """Return steps done and both moments by part, as numbers and tensors, without the Gaussians."""
        return {
            "steps": int(self._steps["means"]),
            **{kind: dict(self._moments[kind]) for kind in MOMENTS},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue, bit for bit, from the state that :meth:`state_dict` returned for the same Gaussians.

        Raises ``UserError`` if the moments are of other Gaussians.
        """
        parts = parts_of(self._gaussians.detach())
        moments: dict[str, Any] = {"steps": state["steps"]}
        for kind in MOMENTS:
            for name, part in parts.items():
                found = state[kind][name].shape
                require(
                    found == part.shape,
                    "resume",
                    expected=f"a checkpoint whose {kind} of {name} has the shape {tuple(part.shape)}",
                    got=tuple(found),
                    example="resume=RUN/checkpoints/<an earlier one>",
                )
            moments[kind] = {name: state[kind][name].to(part, copy=True) for name, part in parts.items()}
        self._install(self._gaussians.detach(), moments)

    @torch.no_grad()
    def _move(self, part: str, gradient: Tensor, rate: float) -> None:
        """Do one step of torch's Adam on one part.

        This calls torch's function instead of its class, because the first object of the class loads torch's
        compiler, which takes more than a second.
        """
        adam(
            [self._parts[part]],
            [gradient],
            [self._moments["exp_avg"][part]],
            [self._moments["exp_avg_sq"][part]],
            [],
            [self._steps[part]],
            amsgrad=False,
            beta1=float(self.settings.beta1),
            beta2=float(self.settings.beta2),
            lr=rate,
            weight_decay=0.0,
            eps=float(self.settings.eps),
            maximize=False,
        )

    def _install(self, gaussians: Gaussians, moments: Mapping[str, Any]) -> None:
        """Make ``gaussians`` the leaf tensors, and give Adam views into them, so that a step moves both."""
        self._gaussians = gaussians.map(lambda tensor: tensor.detach().requires_grad_())
        self._parts = parts_of(self._gaussians.detach())
        self._steps = {name: torch.tensor(float(moments["steps"])) for name in PARTS}
        self._moments = {kind: {name: moments[kind][name].contiguous() for name in PARTS} for kind in MOMENTS}


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


def _clipped(gradient: Tensor, bound: float) -> Tensor:
    """Return ``gradient``, scaled to the Euclidean norm ``bound`` over all elements if it is longer."""
    norm = torch.linalg.vector_norm(gradient)
    return gradient * (bound / norm.clamp_min(bound))
