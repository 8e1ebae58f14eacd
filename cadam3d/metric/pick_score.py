"""PickScore: which of several pictures people would choose for a prompt, as a score."""

from dataclasses import dataclass
from functools import cache
from typing import ClassVar

import torch

from cadam3d.metric.clip import ClipMetric, load_clip
from cadam3d.metric.scoring import Scorer


@dataclass(frozen=True, kw_only=True)
class PickScore(ClipMetric):
    """The cosine between a picture and the text, times the trained factor of the model (about 100).

    The model is a CLIP model that Kirstain et al. (2023) trained on choices of people. A difference of 1
    between two pictures of one text stands for odds of e to 1 that people prefer the one with the higher
    score.
    """

    node: ClassVar[str] = "metric.pick_score"
    number: ClassVar[str] = "pick_score"
    kind: ClassVar[str] = "pick"

    def scorer(self, device: torch.device) -> Scorer:
        """Return the model, which gives each picture a score."""
        clip = load_clip(self.source(), device)
        direction = cache(lambda text: clip.texts([text])[0])
        return Scorer(
            score=lambda images, text: clip.logit_scale * clip.pictures(images) @ direction(text),
            facts=clip.facts,
            complaint=clip.complaint,
        )
