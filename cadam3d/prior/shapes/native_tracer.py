"""The native ray tracer: vectorised and threaded C++ (``kernels/trace.cpp``), compiled at its first use.

It finds the same hits and the same light as ``tracer.py`` in a small part of the time.
"""

import ctypes
from pathlib import Path

import torch

from cadam3d.compiled.library import SIMD, Names, NativeLibrary, build
from cadam3d.core.cameras import Cameras
from cadam3d.io.cache import kernels_dir
from cadam3d.prior import light
from cadam3d.prior.light import light_direction
from cadam3d.prior.shapes import tracer
from cadam3d.prior.shapes.scene import PATTERN_NAMES, Scene, sphere_directions
from cadam3d.prior.shapes.solids import KINDS, STAR_POINTS
from cadam3d.prior.shapes.tracer import Layers, ball_limits, local_origins, ray_matrices

SOURCES = (Path(__file__).parent / "kernels" / "trace.cpp", SIMD)
# Numbers of tracer.py that the kernels use too.
CONSTANTS = ("MARCH_STEPS", "COMPACT_EVERY", "HIT_DISTANCE", "GRAZE_DISTANCE", "BALL_RADIUS", "NEAR")
CONSTANTS += ("NORMAL_STEP", "SPOTS", "SPOT_COSINE")
LIGHTS = ("AMBIENT", "SKY", "DIFFUSE", "WRAP")  # of light.py


def tracer_library(key: str = "prior.tracer") -> NativeLibrary:
    """Return the description of the native tracer, with ``key`` in its messages.

    The numbers of kinds and patterns are definitions, like the constants.
    """
    values = {name: getattr(tracer, name) for name in CONSTANTS} | {"STAR_POINTS": STAR_POINTS}
    values |= {name: getattr(light, name) for name in LIGHTS}
    values |= {f"KIND_{kind.name.upper()}": number for number, kind in enumerate(KINDS)}
    values |= {f"PATTERN_{name.upper()}": number for number, name in enumerate(PATTERN_NAMES)}
    definitions = tuple(f"-DTRACE_{name}={value!r}" for name, value in values.items())
    names = Names(f"{key}=native", fallback=f"{key}=torch")
    return NativeLibrary("tracer", names, SOURCES, definitions, "cadam3d_trace_self_test")


def load_tracer(key: str = "prior.tracer") -> tuple[Path, ctypes.CDLL]:
    """Return the native tracer and its file, and compile it if the user's cache folder lacks it.

    Raises ``UserError``, which names ``key``, if it cannot be compiled.
    """
    built = build(tracer_library(key), kernels_dir(None))
    return built, ctypes.CDLL(str(built))


class _Job(ctypes.Structure):
    """Mirror of ``struct Job`` in kernels/trace.cpp: same order, same types."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in ("views", "height", "width", "samples", "parts", "paints")),
        ("threads", ctypes.c_int64),
        *((name, ctypes.c_void_p) for name in ("origins", "to_world", "starts", "centres", "least")),
        *((name, ctypes.c_void_p) for name in ("to_local", "sizes", "low", "high")),
        *((name, ctypes.c_void_p) for name in ("kinds", "patterns", "part_paints", "light", "spots")),
        *((name, ctypes.c_void_p) for name in ("alpha", "layers")),
    )


@torch.no_grad()
def trace_natively(library: ctypes.CDLL, scene: Scene, cameras: Cameras, samples: int) -> Layers:
    """Return the result of :func:`~cadam3d.prior.shapes.tracer.trace`, in float32 on the CPU."""
    for tensor in (scene.to_local, cameras.intrinsics):
        assert (tensor.dtype, tensor.device.type) == (torch.float32, "cpu")
    fine = cameras.resize(cameras.height * samples, cameras.width * samples)
    origins, shape = fine.positions, (len(cameras), cameras.height, cameras.width)
    alpha, layers = torch.zeros(shape), torch.zeros(*shape, scene.albedo.shape[1])
    kinds = torch.tensor([KINDS.index(kind) for kind, count in scene.kinds for _ in range(count)])
    tensors = [origins, ray_matrices(fine), local_origins(scene, origins), *ball_limits(scene, origins)]
    tensors += [scene.to_local, scene.sizes, scene.low, scene.high, kinds, scene.patterns, scene.paints]
    tensors += [light_direction(alpha), sphere_directions(tracer.SPOTS).float(), alpha, layers]
    # The list keeps the copies alive that a tensor with other strides needs.
    tensors = [tensor.contiguous() for tensor in tensors]
    sizes = (*shape, samples, len(scene.radii), scene.albedo.shape[1], torch.get_num_threads())
    job = _Job(*sizes, *(tensor.data_ptr() for tensor in tensors))
    if library.cadam3d_trace(ctypes.byref(job)) != 0:
        raise MemoryError(f"prior.tracer=native: not enough memory for {shape[2]} x {shape[1]} pixels")
    return Layers(alpha=alpha, paints=layers)
