"""Binary glTF 2.0: the container of a JSON document and one buffer, for Gaussians and for meshes."""

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

LARGEST_FILE = (1 << 32) - 1  # bytes; the file stores its length in 32 bits
HEADER = struct.Struct("<4sII")  # "glTF", version, length of the file
CHUNK = struct.Struct("<I4s")  # length, kind
# Types of numbers (glTF 2.0, section 3.6.2).
FLOAT, UNSIGNED_BYTE, UNSIGNED_SHORT, UNSIGNED_INT = 5126, 5121, 5123, 5125
# Uses of a part of the buffer (section 5.11.5).
VERTEX_BUFFER, INDEX_BUFFER = 34962, 34963


def binary_gltf(document: Mapping[str, Any], body: bytes) -> bytes:
    """Return the content of a file with ``document`` and the buffer ``body``, which may be empty."""
    text = json.dumps(document, separators=(",", ":")).encode("ascii")
    text += b" " * (-len(text) % 4)
    chunks = [CHUNK.pack(len(text), b"JSON"), text]
    if body:
        chunks += [CHUNK.pack(len(body), b"BIN\0"), body]
    length = HEADER.size + sum(map(len, chunks))
    return b"".join([HEADER.pack(b"glTF", 2, length), *chunks])


def linear(rgb: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Return linear light for sRGB colours, both in [0, 1] (IEC 61966-2-1)."""
    return np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)


def srgb(light: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Return sRGB colours for linear light, the inverse of ``linear``."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0) ** (1 / 2.4) - 0.055)
