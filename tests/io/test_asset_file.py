"""Files of Gaussians of any format: found by their content, and upright by default."""

import pytest
import torch

from cadam3d.core.console import heard_by
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.io.asset_file import file_format, read_gaussians
from cadam3d.io.compressed_ply import write_compressed_ply
from cadam3d.io.gaussforge import write_ksplat, write_sog, write_spz4
from cadam3d.io.glb import write_glb
from cadam3d.io.ply import write_ply
from cadam3d.io.splat import write_splat
from cadam3d.io.spz import write_spz


def write_plain_ply(path, gaussians, *, up):
    write_ply(path, gaussians, up=up, pad_sh=0)


WRITERS = {
    "ply": (write_plain_ply, ".ply"),
    "compressed ply": (write_compressed_ply, ".ply"),
    "splat": (write_splat, ".splat"),
    "spz": (write_spz, ".spz"),
    "glb": (write_glb, ".glb"),
    "sog": (write_sog, ".sog"),
    "ksplat": (write_ksplat, ".ksplat"),
    "spz 4": (write_spz4, ".spz"),
}
FORGED = ("sog", "ksplat", "spz 4")


def usual_up(kind: str) -> str:
    return "+y" if kind == "glb" else "-y"


@pytest.fixture(autouse=True)
def _needs_gaussforge(request):
    if "kind" in request.fixturenames and request.getfixturevalue("kind") in FORGED:
        pytest.importorskip("gaussforge")


def messages_of(read) -> list[str]:
    """Return what a call says to the user."""
    said = []
    with heard_by(lambda text, _: said.append(text)):
        read()
    return said


def one_gaussian() -> Gaussians:
    return Gaussians(
        means=torch.tensor([[0.25, -0.5, 0.75]]),
        log_scales=torch.tensor([[-3.0, -2.0, -1.0]]),
        quats=torch.tensor([[0.8, 0.6, 0.0, 0.0]]),
        opacity_logits=torch.tensor([2.0]),
        sh=torch.tensor([[[0.5, 0.0, -0.5]]]),
    )


def without_our_comments(path):
    """Remove the comments that name the program and the up axis."""
    lines = path.read_bytes().split(b"\n")
    path.write_bytes(b"\n".join(line for line in lines if not line.startswith(b"comment cadam3d")))


def assert_similar(first: Gaussians, second: Gaussians) -> None:
    for name in ("means", "log_scales", "rotations", "opacities", "sh"):
        torch.testing.assert_close(getattr(first, name), getattr(second, name), atol=0.05, rtol=0)


@pytest.mark.parametrize("kind", WRITERS)
def test_every_format_is_found_and_upright_by_default(tmp_path, kind):
    write, suffix = WRITERS[kind]
    path = tmp_path / f"a{suffix}"
    write(path, one_gaussian(), up=usual_up(kind))
    if suffix == ".ply":
        without_our_comments(path)
    assert file_format(path) == kind
    assert_similar(read_gaussians(path), one_gaussian())


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize("up", ["-y", "+y", "+z"])
def test_the_up_axis_can_be_given(tmp_path, kind, up):
    write, suffix = WRITERS[kind]
    path = tmp_path / f"a{suffix}"
    write(path, one_gaussian(), up=up)
    if suffix == ".ply":
        without_our_comments(path)
    assert_similar(read_gaussians(path, up=up), one_gaussian())


@pytest.mark.parametrize("kind", ["ply", "compressed ply"])
def test_the_axes_that_a_file_records_take_precedence(tmp_path, kind):
    WRITERS[kind][0](tmp_path / "a.ply", one_gaussian(), up="+z")
    for up in (None, "-y"):
        assert_similar(read_gaussians(tmp_path / "a.ply", up=up), one_gaussian())


@pytest.mark.parametrize("kind", ["ply", "compressed ply", "spz"])
@pytest.mark.parametrize("name", ["asset", "asset.PLY", "asset.splat"])
def test_the_content_decides_rather_than_the_name(tmp_path, kind, name):
    WRITERS[kind][0](tmp_path / name, one_gaussian(), up=usual_up(kind))
    assert file_format(tmp_path / name) == kind
    assert_similar(read_gaussians(tmp_path / name), one_gaussian())


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        (
            "a.ply",
            b"solid teapot",
            "not a ply file, nor another one of .ply|.compressed.ply|.splat|.spz|.glb|.sog|.ksplat:",
        ),
        ("a.ply", b"", "not a ply file"),
        ("a.glb", b"glTF\2\0\0\0", "not a readable glb file"),
        ("a.splat", b"x" * 33, "expected records of 32 bytes, got 33 bytes"),
        ("a.obj", b"v 0 0 0\n", "not a ply file"),
    ],
)
def test_any_other_file_is_one_message(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError) as caught:
        read_gaussians(tmp_path / name)
    assert str(caught.value).startswith(f"{tmp_path / name}: {message}")
    assert str(caught.value).count("Try: ") == 1


@pytest.mark.parametrize("kind", WRITERS)
def test_a_file_that_does_not_record_its_axes_is_read_with_one_line_about_the_assumption(tmp_path, kind):
    write, suffix = WRITERS[kind]
    path = tmp_path / f"a{suffix}"
    write(path, one_gaussian(), up=usual_up(kind))
    if suffix == ".ply":
        assert not messages_of(lambda: read_gaussians(path))
        without_our_comments(path)
    note = "Note: {} does not record its axes, so it is read as -y up. If it is upside down: here=+y"
    notes = [] if kind == "glb" else [note.format(path.name)]
    assert messages_of(lambda: read_gaussians(path, key="here")) == notes
    assert not messages_of(lambda: read_gaussians(path, up="-y"))


def test_an_unknown_axis_is_refused(tmp_path):
    with pytest.raises(UserError, match="up: expected"):
        read_gaussians(tmp_path / "a.ply", up="up")


@pytest.mark.parametrize("name", ["nothing.ply", ".", "null\0byte.ply"])
def test_a_path_that_is_not_a_file_is_one_message(tmp_path, name):
    with pytest.raises(UserError):
        read_gaussians(tmp_path / name)
