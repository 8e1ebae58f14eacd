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

The extension has the kernel ``ellipse``, the projection ``perspective``, the sorting method
``cameraDistance`` and a colour space. ``srgb_rec709_display`` means that colours are blended as they are
displayed, as in 3DGS. ``lin_rec709_display`` means that they are linear light, which a program blends before
it encodes them for the display. three.js r187 does that with all files, so ``colors="linear"`` gives correct
colours there, and only soft edges differ. At SH degree 1 and above the coefficients are then fitted to the
linear colours.

The extension is listed as used but not as required, so other programs show coloured points. glTF defines +y
as up.

Nothing is lost except a few bits of float32: scales are at least 1.2e-38 and at most 3.4e38, and logits of
opacities beyond about 17 become an opacity of 1. glTF does not permit empty arrays, so a file without
Gaussians has an empty scene.

Sources: the glTF 2.0 specification, section 4 (GLB) and 3.6 (accessors), and the text of
KHR_gaussian_splatting (github.com/KhronosGroup/glTF, extensions/2.0/Khronos), which the Khronos Group has
ratified. Drafts stored the logarithms of scales; the ratified text has "linear" scales that "must not be
negative".

:func:`read_glb` reads all Gaussians of the scene, with turns, sizes and places of their nodes.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from cadam3d.core.gaussians import Gaussians, concatenate
from cadam3d.core.rotation import rotation_matrices
from cadam3d.core.sh import MAX_DEGREE, SH_C0, sh_basis
from cadam3d.io.encoding import (
    as_tensor,
    in_file_axes,
    linear_scales,
    opacities,
    scale_logarithms,
    to_bytes,
    unit_quats,
)
from cadam3d.io.frames import band_matrix
from cadam3d.io.gathering import gathered
from cadam3d.io.gltf import DAMAGES, attribute, linear, read_gltf, srgb, write_gltf
from cadam3d.io.reading import unusable

EXTENSION = "KHR_gaussian_splatting"
POINTS = 0  # the mode of drawing
# Whether colours are those of the display or linear light, and the name of the colour space.
COLORS = {"display": "srgb_rec709_display", "linear": "lin_rec709_display"}
ROWS_AT_ONCE = 1 << 13
SURE = 1e-9  # opacities are read as if they were at least this far from 0 and 1
MOST_LEVELS = 64  # of nodes
LARGEST_SKEW = 1e-3  # of the axes of a node, relative to their length


def write_glb(path: Path, gaussians: Gaussians, *, up: str, colors: str = "display") -> None:
    """Write ``gaussians`` atomically, in the axes with up axis ``up`` (see ``frames.py``).

    ``colors`` is one of ``COLORS``. The node is named after the file. Raises ``UserError`` if the file cannot
    be written, or would be larger than 4 GB, which is the limit of the format.
    """
    local = in_file_axes(gaussians, up)
    splatting = {
        "kernel": "ellipse",
        "colorSpace": COLORS[colors],
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    primitive = {"mode": POINTS, "extensions": {EXTENSION: splatting}}
    attributes = _attributes(local, colors) if len(local) else {}
    write_gltf(path, path.stem, attributes, primitive, extensionsUsed=[EXTENSION])


def _attributes(local: Gaussians, colors: str) -> dict[str, np.ndarray]:
    """Return the arrays of the attributes; the bytes of each row are a multiple of four."""
    quats, alphas = unit_quats(local), opacities(local)
    sh = local.sh.numpy()
    diffuse = np.clip(0.5 + SH_C0 * sh[:, 0].astype(np.float64), 0, 1)
    if colors == "linear":
        sh = np.concatenate([_recolored(rows.numpy(), linear) for rows in local.sh.split(ROWS_AT_ONCE)])
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


def _recolored(sh: np.ndarray, curve: Callable[[np.ndarray], np.ndarray]) -> Float[np.ndarray, "n k 3"]:
    """Return coefficients [n k 3] whose colours are ``curve`` of the old ones: exactly at degree 0.

    At other degrees they have the least squared error in evenly drawn directions.
    """
    size = sh.shape[1]
    draw = torch.Generator().manual_seed(0)
    directions = torch.randn(1 if size == 1 else 4 * size, 3, dtype=torch.float64, generator=draw)
    basis = sh_basis(torch.nn.functional.normalize(directions, dim=1), round(size**0.5) - 1).numpy()
    colors = curve(0.5 + np.einsum("dk,nkc->ndc", basis, sh.astype(np.float64))) - 0.5
    return np.einsum("kd,ndc->nkc", np.linalg.pinv(basis), colors)


def read_glb(path: Path, *, up: str = "+y") -> Gaussians:
    """Read the Gaussians of a file into world axes, on the CPU, as float32.

    ``up`` is the up axis of the file; glTF defines +y. Raises ``UserError`` if ``path`` is not such a file.
    """
    document, body = read_gltf(path)
    try:
        found = list(_primitives(document))
        if not found and (document.get("meshes") or EXTENSION not in document.get("extensionsUsed", [])):
            raise unusable(path, f"expected Gaussians ({EXTENSION}), got a file without any, such as a mesh")
        parts = [_part(path, document, body, primitive, matrix, up) for primitive, matrix in found]
    except DAMAGES as error:
        raise unusable(path, f"not a readable glb file ({str(error)[:100] or repr(error)})") from error
    degree = max((part.sh_degree for part in parts), default=0)
    nothing = np.zeros((0, 3), dtype=np.float32)
    empty = Gaussians(*map(as_tensor, (nothing, nothing, np.zeros((0, 4)), nothing[:, 0], nothing[:, None])))
    return concatenate([_with_degree(part, degree) for part in (empty, *parts)])


def _primitives(document: Any) -> Iterator[tuple[Any, Float[np.ndarray, "4 4"]]]:
    """Yield every primitive of Gaussians in the scene, and the matrix of its node."""
    scenes = document.get("scenes", [])
    roots = scenes[document.get("scene", 0)].get("nodes", []) if scenes else []
    waiting, seen = [(number, np.eye(4)) for number in roots], set()
    while waiting:
        number, above = waiting.pop(0)
        if number in seen:
            raise ValueError("its nodes are no tree")
        seen.add(number)
        node = document["nodes"][number]
        matrix = above @ _matrix(node)
        waiting += [(child, matrix) for child in node.get("children", [])]
        primitives = document["meshes"][node["mesh"]]["primitives"] if "mesh" in node else []
        yield from ((each, matrix) for each in primitives if EXTENSION in each.get("extensions", {}))


def _matrix(node: Any) -> Float[np.ndarray, "4 4"]:
    """Return the matrix of a node, relative to the one above it."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    x, y, z, w = map(float, node.get("rotation", (0, 0, 0, 1)))
    matrix = np.eye(4)
    turn = rotation_matrices(torch.tensor([[w, x, y, z]], dtype=torch.float64))[0].numpy()
    matrix[:3, :3] = turn * np.array(node.get("scale", (1, 1, 1)), dtype=np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _part(path: Path, document: Any, body: bytes, primitive: Any, matrix: np.ndarray, up: str) -> Gaussians:
    """Return the Gaussians of a primitive whose node has the matrix ``matrix``, in world axes."""
    numbers, space = primitive["attributes"], primitive["extensions"][EXTENSION].get("colorSpace")

    def values(name: str, width: int) -> np.ndarray:
        found = attribute(document, body, numbers[name])
        if found.shape != (count, width):
            raise ValueError(f"an attribute {name} of another size")
        return found

    count = document["accessors"][numbers["POSITION"]]["count"]
    names = [f"SH_DEGREE_{d}_COEF_{k}" for d in range(MAX_DEGREE + 1) for k in range(2 * d + 1)]
    held = [name for name in names if f"{EXTENSION}:{name}" in numbers]
    if len(held) not in (1, 4, 9, 16) or held != names[: len(held)]:
        raise ValueError("spherical harmonics that are not complete")
    positions, quats = values("POSITION", 3), values(f"{EXTENSION}:ROTATION", 4)
    scales, alphas = values(f"{EXTENSION}:SCALE", 3), values(f"{EXTENSION}:OPACITY", 1)
    coefficients = [values(f"{EXTENSION}:{name}", 3) for name in held]

    def local(rows: slice) -> Gaussians:
        alpha = alphas[rows, 0].astype(np.float64).clip(SURE, 1 - SURE)
        sh = np.stack([each[rows] for each in coefficients], axis=1)
        return _moved(
            Gaussians(
                means=as_tensor(positions[rows]),
                log_scales=as_tensor(scale_logarithms(scales[rows])),
                quats=as_tensor(quats[rows][:, [3, 0, 1, 2]]),
                opacity_logits=as_tensor(np.log(alpha / (1 - alpha))),
                sh=as_tensor(_recolored(sh, srgb) if space == COLORS["linear"] else sh),
            ),
            matrix,
        )

    return gathered(path, count, up, local)


def _moved(gaussians: Gaussians, matrix: Float[np.ndarray, "4 4"]) -> Gaussians:
    """Return Gaussians turned, scaled and moved. Raises ``ValueError`` if the matrix does anything else."""
    if np.array_equal(matrix, np.eye(4)):
        return gaussians
    axes, size = matrix[:3, :3], np.cbrt(np.linalg.det(matrix[:3, :3]))
    if not size > 0 or not np.abs(axes @ axes.T / size**2 - np.eye(3)).max() < LARGEST_SKEW:
        raise ValueError("a node that mirrors or distorts its Gaussians")
    from scipy.spatial.transform import Rotation  # slow to import

    turn = Rotation.from_matrix(axes / size)
    own = Rotation.from_quat(unit_quats(gaussians)[:, [1, 2, 3, 0]])
    bands = [gaussians.sh[:, :1]]
    for degree in range(1, gaussians.sh_degree + 1):
        mixing = band_matrix(degree, tuple(turn.as_matrix().flatten().tolist())).float()
        bands.append(torch.einsum("ij,njc->nic", mixing, gaussians.sh[:, degree**2 : (degree + 1) ** 2]))
    return Gaussians(
        means=as_tensor(gaussians.means.numpy() @ axes.T + matrix[:3, 3]),
        log_scales=gaussians.log_scales + float(np.log(size)),
        quats=as_tensor((turn * own).as_quat()[:, [3, 0, 1, 2]]),
        opacity_logits=gaussians.opacity_logits,
        sh=torch.cat(bands, dim=1),
    )


def _with_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """Return the same Gaussians with coefficients up to a higher degree, which are 0."""
    missing = (degree + 1) ** 2 - gaussians.sh.shape[1]
    return replace(gaussians, sh=torch.nn.functional.pad(gaussians.sh, (0, 0, 0, missing)))
