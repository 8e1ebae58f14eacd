"""PickScore: a score that predicts which picture people would choose for a prompt."""

from dataclasses import dataclass
from typing import ClassVar

import torch

from cadam3d.core.number import Number
from cadam3d.metric.clip import ClipMetric, load_clip
from cadam3d.metric.scoring import Scorer


@dataclass(frozen=True, kw_only=True)
class PickScore(ClipMetric):
    """The cosine between a picture and the text, times the trained factor of the model (about 100).

    The model is a CLIP model that Kirstain et al. (2023) trained on choices of people. If the scores of two
    pictures for one text differ by 1, the odds are e to 1 that people prefer the one with the higher score.
    """

    node: ClassVar[str] = "metric.pick_score"
    numbers: ClassVar[tuple[Number, ...]] = (
        Number(name="pick_score", label="PickScore", digits=2, is_more_better=True, preference=22),
    )
    kind: ClassVar[str] = "pick"

    def scorer(self, device: torch.device) -> Scorer:
        """Return the model, which gives each picture a score."""
        clip = load_clip(self.find(), device)
        return clip.scorer(clip.logit_scale)
