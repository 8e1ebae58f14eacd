"""gsplat with the interface of this project, for comparisons; based on its documented ``rasterization``."""

from dataclasses import dataclass
from importlib.util import find_spec

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.render import RenderOutput
from cadam3d.rasterizer.base import FAR, NEAR, Rasterizer


def why_absent(device: torch.device) -> str | None:
    """Return why gsplat cannot be timed here, or ``None`` if it can."""
    if device.type != "cuda":
        return "it renders on CUDA only"
    if find_spec("gsplat") is None:
        return "it is not installed. Try: pip install gsplat==1.5.3"
    # The import compiles gsplat if it was installed without binaries, and a build may raise any exception.
    try:
        from gsplat.cuda._backend import _C
    except Exception as error:
        return f"it cannot be imported here: {error}"
    return None if _C is not None else "it found no CUDA toolkit to compile its kernels"


@dataclass(frozen=True)
class GsplatRasterizer(Rasterizer):
    """gsplat with the settings closest to our image formation: classic, expected depth, unpacked."""

    def render(
        self,
        gaussians: Gaussians,
        cameras: Cameras,
        background: Float[Tensor, "v 3"],
        absgrad: bool = False,
    ) -> RenderOutput:
        """See :meth:`Rasterizer.render`. It includes the activations, which our kernels compute too."""
        from gsplat import rasterization

        assert not absgrad, "absgrad is never timed"
        images, alphas, extra = rasterization(
            gaussians.means,
            gaussians.quats,
            gaussians.log_scales.exp(),
            gaussians.opacity_logits.sigmoid(),
            gaussians.sh,
            cameras.world_to_camera,
            cameras.intrinsics,
            cameras.width,
            cameras.height,
            near_plane=NEAR,
            far_plane=FAR,
            sh_degree=round(gaussians.sh.shape[1] ** 0.5) - 1,
            packed=False,
            backgrounds=background,
            render_mode="RGB+ED",
        )
        means2d, radii = extra["means2d"], extra["radii"]
        if means2d.requires_grad:
            means2d.retain_grad()
        return RenderOutput(
            rgb=images[..., :3],
            alpha=alphas[..., 0],
            depth=images[..., 3],
            means2d=means2d,
            radii=(radii.amax(dim=-1) if radii.ndim == 3 else radii).to(means2d.dtype),
        )
