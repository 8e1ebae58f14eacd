"""Size: how many Gaussians an asset has, and how many bytes its file takes."""

from dataclasses import dataclass
from typing import ClassVar

from cadam3d.core.number import COUNT, Number
from cadam3d.metric.base import Measurand, Measurement, Metric

MIB = 1 << 20  # bytes


@dataclass(frozen=True, kw_only=True)
class Size(Metric):
    """Number of Gaussians, and size of the written file including any padding."""

    numbers: ClassVar[tuple[Number, ...]] = (
        COUNT,
        Number(name="asset_bytes", label="size of asset.ply", unit="bytes", digits=0, is_more_better=False),
        Number(name="asset_mib", label="size of asset.ply", unit="MiB", digits=2, is_more_better=False),
        Number(name="bytes_per_gaussian", label="bytes per Gaussian", digits=0, is_more_better=None),
        Number(name="median_scale", label="median scale", unit="world units", digits=4, is_more_better=None),
        Number(name="median_opacity", label="median opacity", digits=3, is_more_better=None),
    )

    def measure(self, measurand: Measurand) -> Measurement:
        """Return counts, sizes and medians.

        ``num_gaussians`` is always present. ``asset_bytes``, ``asset_mib`` and ``bytes_per_gaussian`` need a
        file. ``bytes_per_gaussian``, ``median_scale`` (world units, longest axis) and ``median_opacity`` need
        at least one Gaussian.
        """
        gaussians, asset = measurand.gaussians, measurand.asset
        count = len(gaussians)
        sizes: dict[str, float] = {"num_gaussians": count}
        if asset is not None:
            asset_bytes = asset.stat().st_size
            sizes |= {"asset_bytes": asset_bytes, "asset_mib": asset_bytes / MIB}
            if count > 0:
                sizes["bytes_per_gaussian"] = asset_bytes / count
        if count > 0:
            sizes["median_scale"] = float(gaussians.scales.amax(dim=-1).median())
            sizes["median_opacity"] = float(gaussians.opacities.median())
        return Measurement(sizes)
