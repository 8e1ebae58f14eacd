"""The opacity reset of chosen Gaussians (paper sec. 4.4), for optimizers of torch."""

import math

import torch
from jaxtyping import Bool
from torch import Tensor

from cadam3d.core.checks import require, require_range


@torch.no_grad()
def reset_opacities(
    logits: Tensor, rows: Bool[Tensor, "n"], optimizer: torch.optim.Optimizer, value: float = 0.01
) -> int:
    """Lower the opacity of ``rows`` to at most ``value``, in (0, 1), in place, without raising any.

    ``logits`` is the parameter itself, of shape (n,) or (n, 1), before the sigmoid. The moments that
    ``optimizer`` has for exactly these rows become zero, so that old momentum does not undo the reset. The
    gradient of ``logits`` is dropped, for trainers that step the optimizer after the reset. Returns the
    number of lowered opacities.
    """
    require_range("value", value, above=0, below=1)
    is_mask = logits.shape[:1] == rows.shape and logits.numel() == rows.numel()
    require(is_mask, "rows", expected=f"a mask of {len(logits)} Gaussians", got=tuple(rows.shape))
    chosen = rows.view_as(logits)
    ceiling = math.log(value / (1 - value))
    lowered = chosen & (logits > ceiling)
    logits.masked_fill_(lowered, ceiling)
    for moment in optimizer.state.get(logits, {}).values():
        if isinstance(moment, Tensor) and moment.shape == logits.shape:
            moment.masked_fill_(chosen, 0.0)
    logits.grad = None
    return int(lowered.sum())
