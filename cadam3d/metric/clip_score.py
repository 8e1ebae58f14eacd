"""ClipScore: how similar the pictures of an asset are to its prompt."""

from dataclasses import dataclass
from typing import ClassVar

import torch

from cadam3d.core.number import Number
from cadam3d.metric.clip import ClipMetric, load_clip
from cadam3d.metric.scoring import Scorer

PERCENT = 100.0


@dataclass(frozen=True, kw_only=True)
class ClipScore(ClipMetric):
    """100 times the cosine between a picture and the text, in the space of a CLIP model.

    This is CLIPScore (Hessel et al. 2021) on the scale that papers about text-to-3D use: without its factor
    of 2.5, and without replacing negative values by 0.
    """

    node: ClassVar[str] = "metric.clip_score"
    numbers: ClassVar[tuple[Number, ...]] = (
        Number(name="clip_score", label="CLIP score", digits=2, is_more_better=True, preference=31),
    )
    kind: ClassVar[str] = "clip"

    def scorer(self, device: torch.device) -> Scorer:
        """Return the model, which gives each picture a score in [-100, 100]."""
        return load_clip(self.find(), device).scorer(PERCENT)
