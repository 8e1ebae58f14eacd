"""ClipRPrecision: whether a CLIP model finds the prompt of an asset among many, from its pictures."""

import hashlib
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.checks import require
from cadam3d.core.number import Number
from cadam3d.io.prompt_files import read_prompts
from cadam3d.metric.clip import ClipMetric, load_clip
from cadam3d.metric.scoring import LEVEL, Scorer

KEY = "metric.clip_r_precision.prompts"
BATCH = 64  # texts that are read at once


@dataclass(frozen=True, kw_only=True)
class ClipRPrecision(ClipMetric):
    """The share of the pictures that are more similar to the prompt of the asset than to any other of a list.

    This is the CLIP R-Precision of Park et al. (2021) with one relevant text, as Dream Fields (Jain et al.
    2022) and DreamFusion (Poole et al. 2023) measure it. The protocol's text template goes around every
    prompt of the list. An asset whose prompt is not in the list has it as one more candidate.
    """

    node: ClassVar[str] = "metric.clip_r_precision"
    numbers: ClassVar[tuple[Number, ...]] = (
        Number(name="clip_r_precision", label="CLIP R-precision", digits=3, is_more_better=True),
    )
    kind: ClassVar[str] = "clip"

    prompts: str  # a set of this package, or a file with one prompt per line or with a list in YAML

    def prepare(self) -> None:
        """Read the prompts, and find the files of the model."""
        read_candidates(self.prompts)
        super().prepare()

    def scorer(self, device: torch.device) -> Scorer:
        """Return the model, which gives each picture 1 if the text of its asset is the most similar, else 0.

        Raises ``UserError`` if the prompts cannot be read.
        """
        candidates = read_candidates(self.prompts)
        clip = load_clip(self.find(), device)
        texts = [self.protocol.text_of(prompt) for prompt in candidates]
        known = torch.cat([clip.texts(texts[at : at + BATCH]) for at in range(0, len(texts), BATCH)])
        own = cache(lambda text: clip.texts([text])[0])

        def score(images: Tensor, text: str) -> Tensor:
            pictures = clip.pictures(images)
            others = known[[other != text for other in texts]]
            return (pictures @ own(text) > (pictures @ others.T).amax(dim=1)).double()

        digest = hashlib.sha256("\n".join(candidates).encode()).hexdigest()
        facts = {"candidates": len(candidates), "candidates_sha256": digest}
        return Scorer(score=score, facts=clip.facts | facts, complaints=clip.complaints)

    def interval(self, values: Float[Tensor, "v"]) -> dict[str, Any] | None:
        """Return the 95 % interval of the share over viewpoints, by Wilson's formula for a proportion."""
        from scipy.stats import binomtest  # slow to import

        found = binomtest(round(float(values.sum())), len(values)).proportion_ci(LEVEL, method="wilson")
        of = "the share over viewpoints, by Wilson's formula"
        return {"low": found.low, "high": found.high, "level": LEVEL, "of": of}


def read_candidates(source: str) -> list[str]:
    """Return the prompts of a set of this package or of a file, each once, in order.

    Raises ``UserError`` for other files, and for fewer than two prompts.
    """
    candidates = [prompt.text for prompt in read_prompts(source, KEY)]
    require(len(candidates) > 1, KEY, expected="at least two prompts", got=source)
    return candidates
