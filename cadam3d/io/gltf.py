"""Binary glTF 2.0: a JSON document and one buffer, for Gaussians and for triangles."""

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from cadam3d import __version__
from cadam3d.core.errors import UserError
from cadam3d.io.atomic import replacing
from cadam3d.io.reading import opened, unusable

LARGEST_FILE = (1 << 32) - 1  # bytes; the file stores its length in 32 bits
SPARE_BYTES = 1 << 20  # for the document
HEADER = struct.Struct("<4sII")  # "glTF", version, length of the file
CHUNK = struct.Struct("<I4s")  # length, kind
# Types of numbers (glTF 2.0, section 3.6.2) by the kind of an array.
COMPONENTS = {"f4": 5126, "i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
# Exceptions for a document that does not follow the specification.
DAMAGES = (LookupError, TypeError, ValueError, AttributeError, StopIteration, OverflowError, RecursionError)
# Uses of a part of the buffer (section 5.11.5).
VERTEX_BUFFER, INDEX_BUFFER = 34962, 34963


def write_gltf(
    path: Path,
    name: str,
    attributes: Mapping[str, np.ndarray],
    primitive: Mapping[str, Any],
    *,
    indices: np.ndarray | None = None,
    picture: bytes = b"",
    **document: Any,
) -> None:
    """Write a file with one mesh called ``name``, atomically; an empty scene without ``attributes``.

    ``attributes`` are little-endian arrays [n c] by name, whose rows have a multiple of four bytes; integers
    are normalized. ``primitive`` and ``document`` are further entries of the JSON. ``picture`` is a PNG, the
    only image. Raises ``UserError`` if the file cannot be written, or would be larger than 4 GB.
    """
    arrays = [array for array in (indices, *attributes.values()) if array is not None]
    blocks = [array.tobytes() for array in arrays] + [picture + bytes(-len(picture) % 4)]
    body = b"".join(blocks)
    if len(body) > LARGEST_FILE - SPARE_BYTES:
        raise UserError(f"{path}: expected less than 4 GB, got {len(body):,} bytes. Try: 'exporter=[ply]'")
    views: list[dict[str, Any]] = []
    offset = 0
    for block, array in zip(blocks, [*arrays, None], strict=True):
        view = {"buffer": 0, "byteOffset": offset, "byteLength": len(block)}
        if array is not None:
            view["target"] = INDEX_BUFFER if array is indices else VERTEX_BUFFER
        offset += len(block)
        views += [view] if block else []
    first = 0 if indices is None else 1
    numbers = {attribute: number for number, attribute in enumerate(attributes, start=first)}
    mesh = {"attributes": numbers, **primitive} | ({} if indices is None else {"indices": 0})
    whole = {
        "asset": {"version": "2.0", "generator": f"cadam3d {__version__}"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": name}],
    }
    if attributes:
        whole |= {
            "nodes": [{"name": name, "mesh": 0}],
            "meshes": [{"name": name, "primitives": [mesh]}],
            "accessors": [_accessor(number, array) for number, array in enumerate(arrays)],
            "bufferViews": views,
            "buffers": [{"byteLength": len(body)}],
            **document,
        }
        corners = attributes["POSITION"]
        whole["accessors"][first] |= {"min": corners.min(0).tolist(), "max": corners.max(0).tolist()}
    if picture:
        whole["images"] = [{"bufferView": len(arrays), "mimeType": "image/png"}]
    text = json.dumps(whole, separators=(",", ":")).encode("ascii")
    text += b" " * (-len(text) % 4)
    chunks = [CHUNK.pack(len(text), b"JSON"), text]
    if body:
        chunks += [CHUNK.pack(len(body), b"BIN\0"), body]
    length = HEADER.size + sum(map(len, chunks))
    with replacing(path) as temporary:
        temporary.write_bytes(b"".join([HEADER.pack(b"glTF", 2, length), *chunks]))


def _accessor(number: int, array: np.ndarray) -> dict[str, Any]:
    """Return the description of an array, which is the part ``number`` of the buffer."""
    kind = array.dtype.str[1:]
    accessor = {"bufferView": number, "componentType": COMPONENTS[kind], "count": len(array)}
    return accessor | {"type": TYPES[array.shape[1]]} | ({"normalized": True} if kind in ("u1", "u2") else {})


def read_gltf(path: Path) -> tuple[Any, bytes]:
    """Return the JSON document of a file and its buffer. Raises ``UserError`` if it cannot be read."""
    with opened(path) as file:
        content = file.read()
    try:
        document, end = leading_document(content)
        body = b""
        if end < len(content):
            size, _ = CHUNK.unpack_from(content, end)
            body = content[end + CHUNK.size :][:size]
    except (ValueError, struct.error, RecursionError) as error:
        raise unusable(path, f"not a readable glb file ({str(error)[:100]})") from error
    return document, body


def leading_document(content: bytes) -> tuple[Any, int]:
    """Return the JSON document of a glb file, and the place of the byte after it.

    Raises ``ValueError``, ``struct.error`` or ``RecursionError`` if there is none.
    """
    magic, version, _ = HEADER.unpack_from(content)
    length, kind = CHUNK.unpack_from(content, HEADER.size)
    start = HEADER.size + CHUNK.size
    if (magic, version, kind) != (b"glTF", 2, b"JSON"):
        raise ValueError("no glTF 2.0")
    return json.loads(content[start : start + length]), start + length


def attribute(document: Any, body: bytes, number: int) -> Float[np.ndarray, "n c"]:
    """Return the numbers of an accessor of a file; integers become shares of the largest one.

    Raises one of ``DAMAGES`` if the document does not describe numbers of the buffer.
    """
    accessor = document["accessors"][number]
    view = document["bufferViews"][accessor["bufferView"]]
    kind = next(name for name, code in COMPONENTS.items() if code == accessor["componentType"])
    width = next(size for size, name in TYPES.items() if name == accessor["type"])
    row = np.dtype(f"<{kind}").itemsize * width
    stride, first = view.get("byteStride", row), accessor.get("byteOffset", 0)
    start = view.get("byteOffset", 0)
    is_here = view["buffer"] == 0 and min(first, start, accessor["count"], stride - row) >= 0
    if "sparse" in accessor or not is_here:
        raise ValueError("an accessor of another kind")
    part = body[start : start + view["byteLength"]]
    values = np.ndarray((accessor["count"], width), f"<{kind}", part, first, (stride, row // width))
    if kind == "f4":
        return values
    return np.maximum(values / np.iinfo(kind).max, -1.0)


def linear(rgb: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Return linear light for sRGB colours, both in [0, 1] (IEC 61966-2-1)."""
    return np.where(rgb <= 0.04045, rgb / 12.92, ((np.maximum(rgb, 0) + 0.055) / 1.055) ** 2.4)


def srgb(light: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Return sRGB colours for linear light, the inverse of ``linear``."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0) ** (1 / 2.4) - 0.055)
