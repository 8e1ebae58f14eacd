"""The library gsplat behind the interface of our rasterizers, so that both are timed on the same scenes."""

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.rendering import RenderOutput
from cadam3d.rasterizer.base import BLUR, FAR, NEAR, Backend, Rasterizer


class Gsplat(Rasterizer):
    """Renders healthy Gaussians in float32 on a CUDA device; see :class:`Rasterizer`.

    Alpha is capped at 0.999. Radii are half the longer side of a box, rounded up, and absgrad is missing.
    """

    def render(
        self,
        gaussians: Gaussians,
        cameras: Cameras,
        background: Float[Tensor, "v 3"],
        absgrad: bool = False,
    ) -> RenderOutput:
        """See :meth:`Rasterizer.render`."""
        import gsplat

        images, alphas, info = gsplat.rasterization(
            means=gaussians.means,
            quats=gaussians.quats,
            scales=gaussians.scales,
            opacities=gaussians.opacities,
            colors=gaussians.sh,
            viewmats=cameras.world_to_camera.to(gaussians.device),
            Ks=cameras.intrinsics.to(gaussians.device),
            width=cameras.width,
            height=cameras.height,
            near_plane=NEAR,
            far_plane=FAR,
            eps2d=BLUR,
            sh_degree=gaussians.sh_degree,
            packed=False,
            backgrounds=background.to(gaussians.device),
            render_mode="RGB+ED",
        )
        if info["means2d"].requires_grad:
            info["means2d"].retain_grad()
        return RenderOutput(
            rgb=images[..., :3],
            alpha=alphas[..., 0],
            depth=images[..., 3],
            means2d=info["means2d"],
            radii=info["radii"].amax(dim=-1).float(),
        )

    def prepare(self, device: torch.device) -> Backend:
        """Compile or load gsplat's kernels, all of which the first call needs."""
        import gsplat

        turn, scale = torch.ones(1, 4, device=device), torch.ones(1, 3, device=device)
        gsplat.quat_scale_to_covar_preci(turn, scale, compute_preci=False)
        torch.cuda.synchronize(device)
        return super().prepare(device)
