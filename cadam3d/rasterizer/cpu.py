"""The native CPU rasterizer: vectorised and threaded C++ (``kernels/cpu.cpp``), compiled at its first use."""

import ctypes
import weakref
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.compiled.library import SIMD, Names, NativeLibrary, build
from cadam3d.core.cameras import Cameras
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.rendering import RenderOutput
from cadam3d.io.cache import kernels_dir
from cadam3d.rasterizer.base import KERNELS, Backend, Rasterizer, definitions
from cadam3d.rasterizer.native import RenderPass, require_shapes, run_pass

SOURCES = (KERNELS / "cpu.cpp", KERNELS / "splat_math.h", SIMD)
NAMES = Names("rasterizer=cpu", fallback="rasterizer=reference")


@dataclass(frozen=True, kw_only=True)
class CpuRasterizer(Rasterizer):
    """Renders in float32 on ``torch.get_num_threads()`` threads; the bits do not depend on their number.

    Other dtypes are converted on the way in and out. The kernels are compiled at the first use on a machine.
    """

    cache_dir: str | None  # folder

    def render(
        self,
        gaussians: Gaussians,
        cameras: Cameras,
        background: Float[Tensor, "v 3"],
        absgrad: bool = False,
    ) -> RenderOutput:
        """See :meth:`Rasterizer.render`.

        Raises :class:`UserError` if the Gaussians are not on the CPU or the kernels cannot be compiled.
        """
        self.prepare(gaussians.device)
        return rasterize(load_kernels(self.cache_dir), gaussians, cameras, background, absgrad)

    def prepare(self, device: torch.device) -> Backend:
        """See :meth:`Rasterizer.prepare`."""
        if device.type != "cpu":
            raise UserError(
                f"rasterizer=cpu: expected Gaussians on the CPU, got {device}. Try: rasterizer=auto"
            )
        load_kernels(self.cache_dir)
        return super().prepare(device)


def cpu_library() -> NativeLibrary:
    """Return the description of the kernels."""
    return NativeLibrary("rasterizer", NAMES, SOURCES, tuple(definitions()), "cadam3d_self_test")


@cache
def load_kernels(cache_dir: str | None) -> ctypes.CDLL:
    """Return the compiled kernels, and compile them if ``cache_dir`` lacks them. Runs once per process."""
    return ctypes.CDLL(str(build(cpu_library(), kernels_dir(cache_dir))))


def rasterize(
    kernels: ctypes.CDLL,
    gaussians: Gaussians,
    cameras: Cameras,
    background: Float[Tensor, "v 3"],
    absgrad: bool = False,
) -> RenderOutput:
    """Render with the given kernels; see :meth:`Rasterizer.render`."""
    require_shapes(gaussians, cameras, background)
    return run_pass(_CpuPass(kernels, cameras, absgrad), gaussians, background)


# What is wrong, by the ``enum Status`` of the kernels.
FAILURES = {1: "not enough memory", 2: "2^32 or more pairs of a Gaussian and a tile are too many"}


class _Scene(ctypes.Structure):
    """Mirror of ``struct Scene`` in kernels/cpu.cpp: same order, same types."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in ("n", "v", "k", "height", "width", "threads")),
        *(
            (name, ctypes.c_void_p)
            for name in ("means", "log_scales", "quats", "opacity_logits", "sh", "matrices", "intrinsics")
        ),
        ("background", ctypes.c_void_p),
    )


class _CpuPass(RenderPass):
    """One call of the CPU rasterizer; see :class:`RenderPass`."""

    def __init__(self, kernels: ctypes.CDLL, cameras: Cameras, absgrad: bool) -> None:
        super().__init__(cameras, torch.device("cpu"), absgrad)
        self.kernels, self.handle, self.count = kernels, ctypes.c_void_p(), 0

    def project(self, parameters: list[Tensor]) -> tuple[Tensor, Tensor]:
        """See :meth:`RenderPass.project`; also creates the memory that the kernels keep for this pass."""
        v, n = self.views, parameters[0].shape[0]
        self.count = n
        means2d, radii = parameters[0].new_empty(v, n, 2), parameters[0].new_empty(v, n)
        scene = self.scene(parameters, None)
        self.call("cadam3d_project", ctypes.byref(scene), means2d, radii, ctypes.byref(self.handle))
        # When the program ends, another thread may still be in a kernel of this pass. The system frees the
        # memory then.
        weakref.finalize(self, self.kernels.cadam3d_free, self.handle).atexit = False
        return means2d, radii

    def blend(
        self, parameters: list[Tensor], background: Tensor, keeps: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        """See :meth:`RenderPass.blend`."""
        size = (self.views, self.height, self.width)
        rgb, alpha, depth = (background.new_empty(*size, *channels) for channels in ((3,), (), ()))
        scene = self.scene(parameters, background)
        self.call("cadam3d_blend", ctypes.byref(scene), self.handle, rgb, alpha, depth, int(keeps))
        return rgb, alpha, depth

    def blend_backward(
        self, parameters: list[Tensor], background: Tensor, images: list[Tensor | None]
    ) -> list[Tensor | None]:
        """See :meth:`RenderPass.blend_backward`."""
        on_screen = (self.views, parameters[0].shape[0], 2)
        grads = [torch.empty(on_screen), torch.empty(on_screen) if self.absgrad else None]
        grads += [torch.empty_like(tensor) for tensor in parameters]
        scene = self.scene(parameters, background)
        self.call("cadam3d_blend_backward", ctypes.byref(scene), self.handle, *images, *grads)
        return grads

    def centre_backward(self, parameters: list[Tensor], radii: Tensor, grad_means2d: Tensor) -> Tensor:
        """See :meth:`RenderPass.centre_backward`."""
        grad_means, scene = torch.empty_like(parameters[0]), self.scene(parameters, None)
        self.call(
            "cadam3d_centre_backward", ctypes.byref(scene), self.handle, radii, grad_means2d, grad_means
        )
        return grad_means

    def scene(self, parameters: list[Tensor], background: Tensor | None) -> _Scene:
        """Return the arguments that all kernels share; they are valid as long as the tensors live."""
        means, *_, sh = parameters
        sizes = (means.shape[0], self.views, sh.shape[1], self.height, self.width)
        tensors = (*parameters, self.matrices, self.intrinsics)
        return _Scene(
            *sizes,
            torch.get_num_threads(),
            *(tensor.data_ptr() for tensor in tensors),
            None if background is None else background.data_ptr(),
        )

    def call(self, name: str, *arguments: object) -> None:
        """Call a kernel. A tensor is passed as its address, and ``None`` as a null pointer."""
        plain = (ctypes.c_void_p(a.data_ptr()) if isinstance(a, Tensor) else a for a in arguments)
        status = getattr(self.kernels, name)(*plain)
        if status != 0:
            scene = f"{self.count:,} Gaussians in {self.views} views of {self.width} x {self.height} pixels"
            raise MemoryError(f"rasterizer=cpu: {FAILURES[status]} for {scene}")
