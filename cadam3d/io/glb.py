"""Binary glTF 2.0 with the extension ``KHR_gaussian_splatting``: Gaussians as points with attributes.

A header of 12 bytes is followed by a JSON chunk, which describes the arrays, and a binary chunk, which holds
them one after the other, little endian:

| attribute | type | content |
|---|---|---|
| ``POSITION`` | float32 x 3 | position |
| ``KHR_gaussian_splatting:ROTATION`` | float32 x 4 | unit quaternion x, y, z, w |
| ``KHR_gaussian_splatting:SCALE`` | float32 x 3 | standard deviations, linear |
| ``KHR_gaussian_splatting:OPACITY`` | float32 | opacity in [0, 1] |
| ``KHR_gaussian_splatting:SH_DEGREE_l_COEF_n`` | float32 x 3 | SH coefficient ``l^2 + n``, red, green, blue |
| ``COLOR_0`` | uint8 x 4, normalized | linear colour and opacity, for programs without the extension |

The extension has the kernel ``ellipse``, the colour space ``srgb_rec709_display`` (colours are blended as
they are displayed, as in 3DGS), the projection ``perspective`` and the sorting method ``cameraDistance``. It
is listed as used but not as required, so other programs show coloured points. glTF defines +y as up.

Nothing is lost except a few bits of float32: scales are at least 1.2e-38 and at most 3.4e38, and logits of
opacities beyond about 17 become an opacity of 1. glTF does not permit empty arrays, so a file without
Gaussians has an empty scene.

Sources: the glTF 2.0 specification, section 4 (GLB) and 3.6 (accessors), and the text of
KHR_gaussian_splatting (github.com/KhronosGroup/glTF, extensions/2.0/Khronos), which the Khronos Group has
ratified. Drafts stored the logarithms of scales; the ratified text has "linear" scales that "must not be
negative".
"""

from pathlib import Path

import numpy as np

from cadam3d.core.gaussians import Gaussians
from cadam3d.core.sh import SH_C0
from cadam3d.io.encoding import in_file_axes, linear_scales, opacities, to_bytes, unit_quats
from cadam3d.io.gltf import linear, write_gltf

EXTENSION = "KHR_gaussian_splatting"
POINTS = 0  # the mode of drawing


def write_glb(path: Path, gaussians: Gaussians, *, up: str) -> None:
    """Write ``gaussians`` atomically, in the axes with up axis ``up`` (see ``frames.py``).

    The node is named after the file. Raises ``UserError`` if the file cannot be written, or would be larger
    than 4 GB, which is the limit of the format.
    """
    local = in_file_axes(gaussians, up)
    splatting = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    primitive = {"mode": POINTS, "extensions": {EXTENSION: splatting}}
    attributes = _attributes(local) if len(local) else {}
    write_gltf(path, path.stem, attributes, primitive, extensionsUsed=[EXTENSION])


def _attributes(local: Gaussians) -> dict[str, np.ndarray]:
    """Return the arrays of the attributes; the bytes of each row are a multiple of four."""
    quats, alphas = unit_quats(local), opacities(local)
    sh = local.sh.numpy()
    diffuse = np.clip(0.5 + SH_C0 * sh[:, 0].astype(np.float64), 0, 1)
    floats = {
        "POSITION": local.means.numpy(),
        f"{EXTENSION}:ROTATION": quats[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": linear_scales(local),
        f"{EXTENSION}:OPACITY": alphas[:, None],
    }
    for degree in range(local.sh_degree + 1):
        for order in range(2 * degree + 1):
            floats[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}"] = sh[:, degree**2 + order]
    color = np.concatenate([linear(diffuse), alphas[:, None]], axis=1)
    return {name: np.ascontiguousarray(array, dtype="<f4") for name, array in floats.items()} | {
        "COLOR_0": to_bytes(255 * color)
    }
