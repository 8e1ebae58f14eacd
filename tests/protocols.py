"""A small protocol and rendered pictures for the tests of metrics."""

from typing import Any

import torch
from torch import Tensor

from cadam3d.core.rendering import RenderOutput
from cadam3d.metric.protocol import RingProtocol


def ring(**changes: Any) -> RingProtocol:
    """Return a ring of three views on white, of which the mean counts, with some other settings."""
    settings: dict[str, Any] = {
        "name": "small",
        "views": 3,
        "elevations_deg": [0.0],
        "distance": 3.0,
        "fov_y_deg": 40.0,
        "size": 32,
        "background": [1.0, 1.0, 1.0],
        "text": "{}",
        "models": {},
    }
    return RingProtocol(**settings | changes)


def output(rgb: Tensor, alpha: Tensor | None = None) -> RenderOutput:
    """Return what a renderer returns for these pictures "v h w 3", of no Gaussians."""
    alpha = rgb[..., 0] if alpha is None else alpha
    return RenderOutput(rgb, alpha, alpha, torch.zeros(len(rgb), 0, 2), torch.zeros(len(rgb), 0))
