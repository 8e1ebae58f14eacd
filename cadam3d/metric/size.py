"""Size: how much an asset costs to keep and to send."""

from dataclasses import dataclass

from cadam3d.core.gaussians import Gaussians
from cadam3d.core.render import RenderFn, TruthFn
from cadam3d.io.ply import ply_bytes
from cadam3d.metric.base import Metric

MIB = 1 << 20


@dataclass(frozen=True, kw_only=True)
class Size(Metric):
    """Counts Gaussians, and the bytes of ``asset.ply`` at the asset's own SH degree (no padding)."""

    def measure(
        self, gaussians: Gaussians, render: RenderFn, truth: TruthFn | None
    ) -> dict[str, int | float]:
        """``num_gaussians``, ``asset_bytes``, ``asset_mib``, ``bytes_per_gaussian``, ``median_scale``
        (world units, the longest axis) and ``median_opacity``; what has no meaning without Gaussians is
        left out.
        """
        count = len(gaussians)
        asset_bytes = ply_bytes(count, gaussians.sh_degree)
        sizes = {"num_gaussians": count, "asset_bytes": asset_bytes, "asset_mib": asset_bytes / MIB}
        if count == 0:
            return sizes
        return sizes | {
            "bytes_per_gaussian": asset_bytes / count,
            "median_scale": float(gaussians.scales.amax(dim=-1).median()),
            "median_opacity": float(gaussians.opacities.median()),
        }
