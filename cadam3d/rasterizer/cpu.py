"""The native CPU rasterizer: vectorised, threaded C++ behind the same two autograd steps.

``means -> means2d`` is one step, ``means2d and everything else -> images`` the other, so ``means2d`` is an
honest node of the graph: its gradient is there to be retained, and a loss may use it. The kernels are in
``kernels/cpu.cpp``.
"""

import ctypes
import weakref
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from cadam3d.core.cameras import Cameras
from cadam3d.core.checks import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.render import RenderOutput
from cadam3d.rasterizer.base import Rasterizer
from cadam3d.rasterizer.build import build, default_cache_dir, load

SH_SIZES = (1, 4, 9, 16)  # coefficients of degree 0 to 3


@dataclass(frozen=True, kw_only=True)
class CpuRasterizer(Rasterizer):
    """Renders in float32 on ``torch.get_num_threads()`` threads; the bits do not depend on how many.

    Other dtypes are converted on the way in and out. The kernels are compiled at the first use on a machine.
    """

    cache_dir: str | None  # where compiled kernels are kept; None: the user's cache folder

    def render(
        self, gaussians: Gaussians, cameras: Cameras, background: Float[Tensor, "v 3"]
    ) -> RenderOutput:
        """See :meth:`Rasterizer.render`. Raises :class:`UserError` off the CPU or without a compiler."""
        if gaussians.device.type != "cpu":
            raise UserError(f"rasterizer=cpu cannot render on {gaussians.device}. Try: rasterizer=auto")
        return rasterize(load_kernels(self.cache_dir), gaussians, cameras, background)


@cache
def load_kernels(cache_dir: str | None) -> ctypes.CDLL:
    """The compiled kernels; compiles them if they are not in ``cache_dir`` yet. Once per process."""
    return load(build(Path(cache_dir).expanduser() if cache_dir else default_cache_dir()))


def instruction_set(kernels: ctypes.CDLL) -> str:
    """What the kernels were compiled for: ``avx512``, ``avx2``, ``sse2``, ``neon`` or ``generic``."""
    kernels.cadam3d_instruction_set.restype = ctypes.c_char_p
    return kernels.cadam3d_instruction_set().decode()


def rasterize(
    kernels: ctypes.CDLL, gaussians: Gaussians, cameras: Cameras, background: Float[Tensor, "v 3"]
) -> RenderOutput:
    """Render with the kernels at hand; see :meth:`Rasterizer.render`."""
    _require_shapes(gaussians, cameras, background)
    dtype = gaussians.means.dtype
    means, *others = (_plain(tensor) for tensor in gaussians.tensors().values())
    frame = _Frame(kernels, cameras)
    means2d, radii = _Project.apply(frame, means, *(tensor.detach() for tensor in others))
    means2d = means2d.to(dtype)
    if torch.is_grad_enabled():
        means2d.requires_grad_().retain_grad()
    frame.keeps = torch.is_grad_enabled()
    images = _Blend.apply(frame, _plain(means2d), means, *others, _plain(background))
    rgb, alpha, depth = (image.to(dtype) for image in images)
    return RenderOutput(rgb=rgb, alpha=alpha, depth=depth, means2d=means2d, radii=radii.to(dtype))


class _Scene(ctypes.Structure):
    """``struct Scene`` of kernels/cpu.cpp: same order, same types."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in ("n", "v", "k", "height", "width", "threads")),
        *(
            (name, ctypes.c_void_p)
            for name in ("means", "log_scales", "quats", "opacity_logits", "sh", "matrices", "intrinsics")
        ),
        ("background", ctypes.c_void_p),
    )


class _Frame:
    """One call of the rasterizer: its cameras, and what the kernels keep for the way back."""

    def __init__(self, kernels: ctypes.CDLL, cameras: Cameras) -> None:
        self.kernels, self.height, self.width = kernels, cameras.height, cameras.width
        self.matrices = _plain(cameras.world_to_camera.detach())
        self.intrinsics = _plain(cameras.intrinsics.detach())
        self.handle = ctypes.c_void_p()
        self.keeps = False  # whether a backward may come

    def project(self, parameters: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Create the kernels' memory of this frame; ``means2d`` [v n 2] and ``radii`` [v n]."""
        v, n = self.matrices.shape[0], parameters[0].shape[0]
        means2d, radii = parameters[0].new_empty(v, n, 2), parameters[0].new_empty(v, n)
        scene = self.scene(parameters, None)
        self.call("cadam3d_project", ctypes.byref(scene), means2d, radii, ctypes.byref(self.handle))
        weakref.finalize(self, self.kernels.cadam3d_free, self.handle)
        return means2d, radii

    def scene(self, parameters: list[Tensor], background: Tensor | None) -> _Scene:
        """The arguments all kernels share; valid as long as the tensors live."""
        means, *_, sh = parameters
        sizes = (means.shape[0], self.matrices.shape[0], sh.shape[1], self.height, self.width)
        tensors = (*parameters, self.matrices, self.intrinsics)
        return _Scene(
            *sizes,
            torch.get_num_threads(),
            *(tensor.data_ptr() for tensor in tensors),
            None if background is None else background.data_ptr(),
        )

    def call(self, name: str, *arguments: object) -> None:
        """Call a kernel; a tensor is passed as its address, ``None`` as a null pointer."""
        plain = (ctypes.c_void_p(a.data_ptr()) if isinstance(a, Tensor) else a for a in arguments)
        if getattr(self.kernels, name)(*plain) != 0:
            raise MemoryError(f"rasterizer=cpu: not enough memory for {self.width} x {self.height} pixels")


class _Project(torch.autograd.Function):
    """Gaussians to ``means2d`` and ``radii``; differentiable in the means alone, as a centre is."""

    @staticmethod
    def forward(ctx, frame: _Frame, *parameters: Tensor) -> tuple[Tensor, Tensor]:
        means2d, radii = frame.project(list(parameters))
        ctx.frame = frame
        ctx.save_for_backward(*parameters, radii)
        ctx.mark_non_differentiable(radii)
        return means2d, radii

    @staticmethod
    @once_differentiable
    def backward(ctx, *grads: Tensor) -> tuple[Tensor | None, ...]:
        *parameters, radii = ctx.saved_tensors
        grad_means = torch.empty_like(parameters[0])
        scene = ctx.frame.scene(parameters, None)
        ctx.frame.call(
            "cadam3d_centre_backward", ctypes.byref(scene), radii, grads[0].contiguous(), grad_means
        )
        return None, grad_means, None, None, None, None


class _Blend(torch.autograd.Function):
    """``means2d``, the raw parameters and the backgrounds to images."""

    @staticmethod
    def forward(ctx, frame: _Frame, means2d: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
        *parameters, background = tensors
        size = (background.shape[0], frame.height, frame.width)
        rgb, alpha, depth = (means2d.new_empty(*size, *channels) for channels in ((3,), (), ()))
        scene = frame.scene(parameters, background)
        frame.call("cadam3d_blend", ctypes.byref(scene), frame.handle, rgb, alpha, depth, int(frame.keeps))
        ctx.frame = frame
        ctx.save_for_backward(*tensors, alpha, depth)
        ctx.set_materialize_grads(False)
        return rgb, alpha, depth

    @staticmethod
    @once_differentiable
    def backward(ctx, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        *parameters, background, alpha, depth = ctx.saved_tensors
        images = (alpha, depth, *(None if grad is None else grad.contiguous() for grad in grads))
        grad_means2d = torch.zeros(background.shape[0], parameters[0].shape[0], 2)
        totals = [torch.zeros_like(tensor) for tensor in parameters]
        scene, handle = ctx.frame.scene(parameters, background), ctx.frame.handle
        ctx.frame.call("cadam3d_blend_backward", ctypes.byref(scene), handle, *images, grad_means2d, *totals)
        grad_background = None
        if ctx.needs_input_grad[-1] and grads[0] is not None:
            grad_background = (grads[0] * (1 - alpha)[..., None]).sum(dim=(1, 2))
        return None, grad_means2d, *totals, grad_background


def _plain(tensor: Tensor) -> Tensor:
    return tensor.to("cpu", torch.float32).contiguous()


def _require_shapes(gaussians: Gaussians, cameras: Cameras, background: Tensor) -> None:
    # Kernels trust what they are told: a wrong shape would read foreign memory.
    n, v, k = len(gaussians), len(cameras), gaussians.sh.shape[1]
    wanted = {"means": (n, 3), "log_scales": (n, 3), "quats": (n, 4), "opacity_logits": (n,), "sh": (n, k, 3)}
    shapes = {name: tuple(tensor.shape) for name, tensor in gaussians.tensors().items()}
    if shapes != wanted or k not in SH_SIZES:
        raise ValueError(f"Gaussians: wanted {wanted} with k in {SH_SIZES}, got {shapes}")
    views = [tuple(each.shape) for each in (cameras.world_to_camera, cameras.intrinsics, background)]
    if views != [(v, 4, 4), (v, 3, 3), (v, 3)] or min(cameras.height, cameras.width) < 1:
        raise ValueError(f"cameras and background: wanted (v, 4, 4), (v, 3, 3), (v, 3), got {views}")
