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
from cadam3d.io.frames import UPS, file_to_world, turned
from cadam3d.io.glb import read_glb, write_glb

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


# Reading


def edited(path, change) -> None:
    """Change the JSON of a file in place."""
    content = path.read_bytes()
    length = struct.unpack_from("<I", content, 12)[0]
    document = json.loads(content[20 : 20 + length])
    change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    path.write_bytes(content[:12] + struct.pack("<I4s", len(text), b"JSON") + text + content[20 + length :])


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("up", UPS)
def test_what_is_written_is_read(tmp_path, degree, up):
    gaussians = random_gaussians(30, degree)
    write_glb(tmp_path / "a.glb", gaussians, up=up)
    back = errors(read_glb(tmp_path / "a.glb", up=up), gaussians)
    assert max(back.values()) < 1e-4


def test_linear_colours_are_linear_light_and_are_read_back(tmp_path):
    gaussians = asset(3)
    write_glb(tmp_path / "a.glb", gaussians, up="+y", colors="linear")
    assert likeness_db(read_glb(tmp_path / "a.glb"), 3) > 40
    document, arrays = parsed((tmp_path / "a.glb").read_bytes())
    space = document["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]["colorSpace"]
    assert space == "lin_rec709_display"
    flat = random_gaussians(30, 0)
    write_glb(tmp_path / "a.glb", flat, up="+y", colors="linear")
    assert errors(read_glb(tmp_path / "a.glb"), flat)["sh0"] < 1e-4
    _, arrays = parsed((tmp_path / "a.glb").read_bytes())
    shown = 0.5 + SH_C0 * flat.sh[:, 0].double().numpy()
    light = 0.5 + SH_C0 * arrays[f"{NAMESPACE}SH_DEGREE_0_COEF_0"]
    assert np.allclose(light, gltf.linear(shown), atol=1e-5)


def test_nodes_turn_scale_and_move_their_gaussians(tmp_path):
    gaussians = random_gaussians(30, 3)
    write_glb(tmp_path / "a.glb", gaussians, up="+y")
    half = 0.5**0.5

    def change(document):
        document["nodes"] = [
            {"children": [1], "scale": [2, 2, 2]},
            {"mesh": 0, "rotation": [0, half, 0, half]},
        ]
        document["nodes"][1]["translation"] = [0, 3, 0]

    edited(tmp_path / "a.glb", change)
    # A quarter turn about the y axis of the file is one about the z axis of the world.
    wanted = turned(gaussians, 90)
    found = read_glb(tmp_path / "a.glb")
    torch.testing.assert_close(found.means, 2 * (wanted.means + torch.tensor([0.0, 0.0, 3.0])))
    # ``turned`` renames the axes of each Gaussian too, which leaves its covariance as it is.
    axes = [each.rotations * each.scales[:, None] for each in (found, wanted)]
    torch.testing.assert_close(axes[0] @ axes[0].mT, 4 * axes[1] @ axes[1].mT, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(found.sh, wanted.sh, atol=1e-4, rtol=0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d["nodes"][0].update(scale=[1, 2, 1]), "mirrors or distorts"),
        (lambda d: d["nodes"][0].update(scale=[-1, 1, 1]), "mirrors or distorts"),
        (lambda d: d["nodes"][0].update(children=[0]), "no tree"),
        (lambda d: d["accessors"][0].update(count=1 << 40), "not a readable glb"),
        (lambda d: d["bufferViews"][0].update(byteStride=0), "another kind"),
        (lambda d: d["bufferViews"][0].update(byteOffset=-4), "another kind"),
        (lambda d: d.update(meshes=None), "not a readable glb"),
        (lambda d: d["meshes"][0]["primitives"][0].pop("extensions"), "such as a mesh"),
        (
            lambda d: (d["meshes"][0]["primitives"][0].pop("extensions"), d.pop("extensionsUsed")),
            "such as a mesh",
        ),
    ],
)
def test_a_file_that_does_not_describe_gaussians_is_one_message(tmp_path, change, message):
    path = tmp_path / "a.glb"
    write_glb(path, random_gaussians(3, 1), up="+y")
    edited(path, change)
    with pytest.raises(UserError, match=message) as caught:
        read_glb(path)
    assert str(caught.value).startswith(f"{path}: ")
