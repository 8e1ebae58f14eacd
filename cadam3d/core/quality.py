"""Quality: how each number that describes an asset is printed, and whether more or less of it is better.

These are numbers of ``summary.json`` and ``eval.json``. Reports, tables and ``select=`` read this list.
"""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Quality:
    """A number that a metric measures of an asset."""

    name: str  # in summary.json and eval.json
    metric: str  # the option of ``metric=`` that measures it
    label: str  # for columns and within sentences
    unit: str = ""  # empty if there is none
    decimals: int  # after the point
    is_more_better: bool | None  # None = neither more nor less is better
    explained: str = ""  # a longer label with its unit, for lists of facts; empty = the heading

    @property
    def heading(self) -> str:
        """Return the label with its unit, such as ``PSNR (dB)``."""
        return f"{self.label} ({self.unit})" if self.unit else self.label

    @property
    def fact(self) -> str:
        """Return the label for a list of facts, such as ``Median scale (world units)``."""
        text = self.explained or self.heading
        return text[0].upper() + text[1:]

    def written(self, value: float) -> str:
        """Return a value as text with its unit, such as ``23.41 dB``."""
        return f"{value:,.{self.decimals}f} {self.unit}".rstrip()

    def merit(self, value: float) -> float:
        """Return a number that is larger for a better value. Requires that more or less is better."""
        assert self.is_more_better is not None
        return value if self.is_more_better else -value


# The numbers that replace others if the asset may face any side. They compare at the turn at which the asset
# fits best, and the others may compare with a wrong side.
AT_BEST_TURN = {"psnr": "psnr_turned", "ssim": "ssim_turned"}

# In the order in which a list of facts shows them.
QUALITIES = {
    quality.name: quality
    for quality in (
        Quality(
            name="num_gaussians",
            metric="size",
            label="Gaussians",
            decimals=0,
            is_more_better=False,
        ),
        Quality(
            name="asset_bytes",
            metric="size",
            label="size of asset.ply",
            unit="bytes",
            decimals=0,
            is_more_better=False,
        ),
        Quality(
            name="asset_mib",
            metric="size",
            label="size of asset.ply",
            unit="MiB",
            decimals=2,
            is_more_better=False,
        ),
        Quality(
            name="bytes_per_gaussian",
            metric="size",
            label="bytes per Gaussian",
            decimals=0,
            is_more_better=None,
        ),
        Quality(
            name="median_scale",
            metric="size",
            label="median scale",
            unit="world units",
            decimals=4,
            is_more_better=None,
        ),
        Quality(
            name="median_opacity",
            metric="size",
            label="median opacity",
            decimals=3,
            is_more_better=None,
        ),
        Quality(
            name="psnr",
            metric="fidelity",
            label="PSNR",
            unit="dB",
            decimals=2,
            is_more_better=True,
        ),
        Quality(
            name="psnr_min",
            metric="fidelity",
            label="PSNR of the worst view",
            unit="dB",
            decimals=2,
            is_more_better=True,
        ),
        Quality(
            name="ssim",
            metric="fidelity",
            label="SSIM",
            decimals=4,
            is_more_better=True,
        ),
        Quality(
            name="mode",
            metric="fidelity",
            label="best-matching mode of the truth",
            decimals=0,
            is_more_better=None,
        ),
        Quality(
            name="psnr_turned",
            metric="fidelity",
            label="PSNR at the best turn",
            unit="dB",
            decimals=2,
            is_more_better=True,
        ),
        Quality(
            name="ssim_turned",
            metric="fidelity",
            label="SSIM at the best turn",
            decimals=4,
            is_more_better=True,
        ),
        Quality(
            name="turn_deg",
            metric="fidelity",
            label="best turn about the vertical axis",
            unit="degrees",
            decimals=0,
            is_more_better=None,
        ),
        Quality(
            name="psnr_start",
            metric="fidelity",
            label="PSNR at the start",
            unit="dB",
            decimals=2,
            is_more_better=True,
            explained="PSNR of the Gaussians at the start (dB)",
        ),
        Quality(
            name="iou",
            metric="outline",
            label="IoU",
            decimals=3,
            is_more_better=True,
            explained="Overlap of the outlines (IoU)",
        ),
        Quality(
            name="iou_start",
            metric="outline",
            label="IoU at the start",
            decimals=3,
            is_more_better=True,
            explained="Overlap of the outlines at the start (IoU)",
        ),
        Quality(
            name="colour_error",
            metric="outline",
            label="colour error",
            decimals=1,
            is_more_better=False,
            explained="Colour error (delta E)",
        ),
        Quality(
            name="mesh_chamfer",
            metric="mesh",
            label="Chamfer distance of the mesh",
            unit="world units",
            decimals=4,
            is_more_better=False,
        ),
        Quality(
            name="mesh_fscore",
            metric="mesh",
            label="F-score of the mesh",
            decimals=3,
            is_more_better=True,
        ),
        Quality(
            name="mesh_precision",
            metric="mesh",
            label="precision of the mesh",
            decimals=3,
            is_more_better=True,
        ),
        Quality(
            name="mesh_recall",
            metric="mesh",
            label="recall of the mesh",
            decimals=3,
            is_more_better=True,
        ),
        Quality(
            name="clip_score",
            metric="clip_score",
            label="CLIP score",
            decimals=2,
            is_more_better=True,
        ),
        Quality(
            name="clip_r_precision",
            metric="clip_r_precision",
            label="CLIP R-precision",
            decimals=3,
            is_more_better=True,
        ),
        Quality(
            name="pick_score",
            metric="pick_score",
            label="PickScore",
            decimals=2,
            is_more_better=True,
        ),
        Quality(
            name="hps",
            metric="hps",
            label="HPS v2",
            decimals=3,
            is_more_better=True,
        ),
        Quality(
            name="image_reward",
            metric="image_reward",
            label="ImageReward",
            decimals=3,
            is_more_better=True,
        ),
        Quality(
            name="niqe",
            metric="niqe",
            label="NIQE",
            decimals=3,
            is_more_better=False,
        ),
        Quality(
            name="vqa",
            metric="vqa",
            label="VQA score",
            decimals=3,
            is_more_better=True,
            explained="Probability that a vision-language model answers yes",
        ),
        Quality(
            name="janus",
            metric="janus",
            label="Janus score",
            decimals=3,
            is_more_better=False,
        ),
        Quality(
            name="janus_fronts",
            metric="janus",
            label="fronts",
            decimals=0,
            is_more_better=None,
        ),
    )
}
