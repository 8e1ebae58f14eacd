"""What the native rasterizers are made of: the folder of their kernels, and the constants of the model."""

from pathlib import Path

from cadam3d.compiled.build import SIMD, Library, Names
from cadam3d.rasterizer import base

KERNELS = Path(__file__).parent / "kernels"
CONSTANTS = ("BLUR", "ALPHA_MIN", "ALPHA_MAX", "TRANSMITTANCE_MIN", "NEAR", "FAR", "FRUSTUM_MARGIN")
CPU_SOURCES = (KERNELS / "cpu.cpp", KERNELS / "splat_math.h", SIMD)
CPU_NAMES = Names("rasterizer=cpu", fallback="rasterizer=reference", cache_key="rasterizer.cache_dir")
CUDA_NAMES = Names("rasterizer=cuda", fallback="rasterizer=reference", cache_key="rasterizer.cache_dir")


def cpu_library() -> Library:
    """Return the description of the CPU rasterizer."""
    return Library("rasterizer", CPU_NAMES, CPU_SOURCES, tuple(definitions()), "cadam3d_self_test")


def definitions() -> list[str]:
    """Return the compiler flags that define the constants of the image formation model."""
    return [f"-DSPLAT_{name}={getattr(base, name)!r}" for name in CONSTANTS]
