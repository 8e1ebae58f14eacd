"""Published: the paper's table 1, with every number as it is printed there.

The paper does not list the views, models and prompts with which it measures, so these numbers are shown
beside ours and never combined with them. Its "MB" are MiB: 1706K Gaussians of 68 bytes each take 110.6 MiB.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from cadam3d.core.number import COUNT, Number

# The columns of the paper: CLIP, ImgRwd, HPS v2, NIQE, # Gaussians, Storage.
SCORES = (
    Number(name="clip_score", label="CLIP score", digits=2, is_more_better=True),
    Number(name="image_reward", label="ImageReward", digits=3, is_more_better=True),
    Number(name="hps", label="HPS v2", digits=3, is_more_better=True),
    Number(name="niqe", label="NIQE", digits=3, is_more_better=False),
)
SIZES = (
    COUNT,
    Number(name="asset_mib", label="size of asset.ply", unit="MiB", digits=2, is_more_better=False),
)


@dataclass(frozen=True)
class PublishedRow:
    """A row of the paper's table."""

    objective: str
    recipe: str  # the option of ``experiment`` that stands for its backbone
    arm: str
    texts: Mapping[str, str]  # by the name of a number


def _row(objective: str, recipe: str, arm: str, line: str) -> PublishedRow:
    names = [each.name for each in (*SCORES, *SIZES)]
    return PublishedRow(objective, recipe, arm, dict(zip(names, line.split(), strict=True)))


# The first row of each objective is the baseline.
ROWS = (
    _row("SDS", "gaussiandreamer", "baseline", "30.14 -0.125 0.194 9.908 1067K 46.4MB"),
    _row("SDS", "gaussiandreamer", "cadam", "29.95 -0.028 0.185 9.643 143K 6.1MB"),
    _row("ISM", "luciddreamer", "baseline", "31.10 0.413 0.225 6.438 1706K 110.6MB"),
    _row("ISM", "luciddreamer", "cadam", "28.48 0.518 0.225 8.167 81K 5.3MB"),
    _row("VFDS", "flowdreamer", "baseline", "29.88 0.436 0.235 7.183 3373K 218.8MB"),
    _row("VFDS", "flowdreamer", "cadam", "29.21 0.486 0.237 8.891 82K 5.3MB"),
)
