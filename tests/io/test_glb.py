"""glb files: an independent parser finds every attribute of KHR_gaussian_splatting where glTF says it is."""

import json
import struct

import numpy as np
import pytest
import torch
from formats import (
    WRONG_DB,
    asset,
    errors,
    extreme_gaussians,
    likeness_db,
    random_gaussians,
)

from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.io import gltf
from cadam3d.io.frames import UPS, file_to_world
from cadam3d.io.glb import write_glb

NAMESPACE = "KHR_gaussian_splatting:"
COMPONENTS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
SH_C0 = 0.28209479177387814


def parsed(content: bytes) -> tuple[dict, dict[str, np.ndarray]]:
    """Return the JSON and the attributes of the first primitive, checked against glTF 2.0."""
    magic, version, length = struct.unpack_from("<4sII", content)
    assert (magic, version, length) == (b"glTF", 2, len(content))
    json_length, kind = struct.unpack_from("<I4s", content, 12)
    assert kind == b"JSON"
    assert json_length % 4 == 0
    document = json.loads(content[20 : 20 + json_length])
    if "meshes" not in document:
        assert length == 20 + json_length
        return document, {}
    binary_length, kind = struct.unpack_from("<I4s", content, 20 + json_length)
    assert kind == b"BIN\0"
    assert binary_length % 4 == 0
    binary = content[28 + json_length :]
    assert len(binary) == binary_length == document["buffers"][0]["byteLength"]
    primitive = document["meshes"][0]["primitives"][0]
    arrays = {}
    for name, index in primitive["attributes"].items():
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        dtype = {5126: np.dtype("<f4"), 5121: np.dtype("u1")}[accessor["componentType"]]
        shape = accessor["count"], COMPONENTS[accessor["type"]]
        assert view["byteOffset"] % 4 == 0
        assert view["byteLength"] == np.prod(shape) * dtype.itemsize
        array = np.frombuffer(binary, dtype, np.prod(shape), view["byteOffset"]).reshape(shape)
        arrays[name] = array / 255 if accessor.get("normalized") else array
    return document, arrays


def gaussians_of(arrays: dict[str, np.ndarray], up: str) -> Gaussians:
    """Return the Gaussians that the attributes describe, in world axes."""
    own = {name.removeprefix(NAMESPACE): np.array(array) for name, array in arrays.items()}
    sh, degree = [], 0
    while f"SH_DEGREE_{degree}_COEF_0" in own:
        sh += [own[f"SH_DEGREE_{degree}_COEF_{order}"] for order in range(2 * degree + 1)]
        degree += 1
    x, y, z, w = own["ROTATION"].T
    local = Gaussians(
        means=torch.from_numpy(own["POSITION"]),
        log_scales=torch.from_numpy(own["SCALE"]).log(),
        quats=torch.from_numpy(np.stack([w, x, y, z], axis=1)),
        opacity_logits=torch.from_numpy(own["OPACITY"][:, 0]).logit(),
        sh=torch.from_numpy(np.stack(sh, axis=1)),
    )
    return file_to_world(local, up)


@pytest.mark.parametrize("up", UPS)
@pytest.mark.parametrize("degree", [0, 3])
def test_every_attribute_has_the_numbers_of_the_gaussians(tmp_path, degree, up):
    gaussians = random_gaussians(60, degree=degree)
    write_glb(tmp_path / "a.glb", gaussians, up=up)
    back = errors(gaussians_of(parsed((tmp_path / "a.glb").read_bytes())[1], up), gaussians)
    assert back.pop("means") == 0
    assert max(back.values()) < 1e-5


def test_the_extension_is_declared_as_the_specification_says(tmp_path):
    write_glb(tmp_path / "snow man.glb", random_gaussians(10, degree=1), up="+y")
    document, arrays = parsed((tmp_path / "snow man.glb").read_bytes())
    assert document["asset"]["version"] == "2.0"
    assert document["asset"]["generator"].startswith("cadam3d ")
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert "extensionsRequired" not in document
    assert document["nodes"] == [{"name": "snow man", "mesh": 0}]
    primitive = document["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"] == {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    position = document["accessors"][primitive["attributes"]["POSITION"]]
    assert np.array_equal(np.float32(position["min"]), arrays["POSITION"].min(axis=0))
    assert np.array_equal(np.float32(position["max"]), arrays["POSITION"].max(axis=0))


def test_the_numbers_are_activated_and_quaternions_have_length_one(tmp_path):
    gaussians = random_gaussians(60)
    write_glb(tmp_path / "a.glb", gaussians, up="+z")
    _, arrays = parsed((tmp_path / "a.glb").read_bytes())
    assert np.allclose(arrays[NAMESPACE + "SCALE"], gaussians.scales, rtol=1e-6)
    assert np.allclose(arrays[NAMESPACE + "OPACITY"][:, 0], gaussians.opacities, atol=1e-6)
    assert np.allclose(np.linalg.norm(arrays[NAMESPACE + "ROTATION"], axis=1), 1, atol=1e-6)


def test_programs_without_the_extension_show_linear_colours(tmp_path):
    gaussians = random_gaussians(2)
    for row, grey in enumerate((0.5, 1.7)):
        gaussians.sh[row] = (grey - 0.5) / SH_C0
    write_glb(tmp_path / "a.glb", gaussians, up="+y")
    _, arrays = parsed((tmp_path / "a.glb").read_bytes())
    # sRGB 0.5 is 0.214 in linear light; colours above 1 are clamped.
    assert np.allclose(arrays["COLOR_0"][:, :3], [[0.214] * 3, [1.0] * 3], atol=0.002)
    assert np.allclose(arrays["COLOR_0"][:, 3], gaussians.opacities, atol=0.002)


@pytest.mark.parametrize("degree", [0, 3])
def test_the_picture_stays_and_a_wrong_up_axis_shows(tmp_path, degree):
    write_glb(tmp_path / "a.glb", asset(degree), up="+y")
    _, arrays = parsed((tmp_path / "a.glb").read_bytes())
    assert likeness_db(gaussians_of(arrays, "+y"), degree) > 60
    assert likeness_db(gaussians_of(arrays, "-y"), degree) < WRONG_DB


@pytest.mark.parametrize("degree", [0, 3])
def test_extreme_numbers_stay_within_the_specification(tmp_path, degree):
    write_glb(tmp_path / "a.glb", extreme_gaussians(degree), up="+y")
    _, arrays = parsed((tmp_path / "a.glb").read_bytes())
    assert all(np.isfinite(array).all() for array in arrays.values())
    assert (arrays[NAMESPACE + "SCALE"] > 0).all()
    assert ((arrays[NAMESPACE + "OPACITY"] >= 0) & (arrays[NAMESPACE + "OPACITY"] <= 1)).all()
    assert np.allclose(np.linalg.norm(arrays[NAMESPACE + "ROTATION"], axis=1), 1, atol=1e-6)


def test_a_file_without_gaussians_is_an_empty_scene(tmp_path):
    write_glb(tmp_path / "a.glb", random_gaussians(0), up="+y")
    document, _ = parsed((tmp_path / "a.glb").read_bytes())
    assert document["nodes"] == [{"name": "a"}]
    assert not {"meshes", "accessors", "buffers", "extensionsUsed"} & set(document)


def test_the_same_gaussians_give_the_same_bytes(tmp_path):
    for folder in ("first", "second"):
        write_glb(tmp_path / folder / "a.glb", random_gaussians(20), up="+y")
    assert (tmp_path / "first/a.glb").read_bytes() == (tmp_path / "second/a.glb").read_bytes()


def test_a_file_beyond_the_limit_of_the_format_is_one_message(tmp_path, monkeypatch):
    monkeypatch.setattr(gltf, "LARGEST_FILE", 1000)
    with pytest.raises(UserError, match=r"less than 4 GB, got .*Try: 'exporter=\[ply\]'$"):
        write_glb(tmp_path / "a.glb", random_gaussians(30), up="+y")
    assert not list(tmp_path.iterdir())
