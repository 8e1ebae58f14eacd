"""PLY files: the same bits after a round trip, the usual layout, and clear errors for all other files."""

import struct
from pathlib import Path

import numpy as np
import pytest
import torch

from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.io.frames import UPS
from cadam3d.io.ply import read_ply, write_ply


def random_gaussians(n: int = 50, degree: int = 3, seed: int = 0) -> Gaussians:
    draw = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=draw)

    return Gaussians(normal(n, 3), normal(n, 3), normal(n, 4), normal(n), normal(n, (degree + 1) ** 2, 3))


def assert_same_bits(actual: Gaussians, expected: Gaussians) -> None:
    for name, tensor in expected.tensors().items():
        assert actual.tensors()[name].numpy().tobytes() == tensor.contiguous().numpy().tobytes(), name


def property_names(path) -> list[str]:
    header = path.read_bytes().split(b"end_header")[0].decode()
    return [line.split()[-1] for line in header.splitlines() if line.startswith("property")]


def hand_made(names, rows, kinds=None, version="binary_little_endian 1.0", before="", after="") -> bytes:
    """Return a PLY file that is built without the code under test."""
    kinds = kinds or ["float"] * len(names)
    declared = "".join(f"property {kind} {name}\n" for kind, name in zip(kinds, names, strict=True))
    header = f"ply\nformat {version}\n{before}element vertex {len(rows)}\n{declared}{after}end_header\n"
    code = {"float": "f", "double": "d", "uchar": "B"}
    layout = "<" + "".join(code[kind] for kind in kinds)
    return header.encode() + b"".join(struct.pack(layout, *row) for row in rows)


NAMES = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
NAMES += ["rot_0", "rot_1", "rot_2", "rot_3"]


# Laws


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_round_trip_in_world_axes_returns_the_same_bits(tmp_path, degree):
    gaussians = random_gaussians(degree=degree)
    write_ply(tmp_path / "a.ply", gaussians, up="+z", pad_sh=0)
    assert_same_bits(read_ply(tmp_path / "a.ply"), gaussians)


@pytest.mark.parametrize("up", UPS)
@pytest.mark.parametrize("degree", [0, 1])
def test_the_round_trip_in_any_axes_returns_the_same_bits_up_to_degree_one(tmp_path, up, degree):
    gaussians = random_gaussians(degree=degree)
    write_ply(tmp_path / "a.ply", gaussians, up=up, pad_sh=0)
    assert_same_bits(read_ply(tmp_path / "a.ply"), gaussians)


def test_extreme_numbers_are_preserved(tmp_path):
    gaussians = random_gaussians(n=4, degree=0)
    gaussians.means[:, 0] = torch.tensor([0.0, -0.0, 1e-45, 3e38])
    write_ply(tmp_path / "a.ply", gaussians, up="-y", pad_sh=0)
    assert_same_bits(read_ply(tmp_path / "a.ply"), gaussians)


@pytest.mark.parametrize("degree", [0, 3])
def test_a_file_without_gaussians_is_valid(tmp_path, degree):
    write_ply(tmp_path / "a.ply", random_gaussians(n=0, degree=degree), up="-y", pad_sh=0)
    back = read_ply(tmp_path / "a.ply")
    assert len(back) == 0
    assert back.sh_degree == degree


def test_padding_adds_zeros_and_changes_nothing_else(tmp_path):
    gaussians = random_gaussians(degree=1)
    write_ply(tmp_path / "a.ply", gaussians, up="-y", pad_sh=3)
    back = read_ply(tmp_path / "a.ply")
    assert len(property_names(tmp_path / "a.ply")) * 4 == 248
    assert torch.equal(back.sh[:, :4], gaussians.sh)
    assert back.sh[:, 4:].abs().max() == 0


# Layout


def test_the_file_of_one_gaussian_equals_one_written_by_hand(tmp_path):
    gaussians = Gaussians(
        means=torch.tensor([[1.0, 2.0, 3.0]]),
        log_scales=torch.tensor([[-1.0, -2.0, -3.0]]),
        quats=torch.tensor([[2.0, 0.25, 0.5, 0.75]]),
        opacity_logits=torch.tensor([4.0]),
        sh=torch.arange(12.0).reshape(1, 4, 3),  # coefficient k, channel c: 3 k + c
    )
    write_ply(tmp_path / "a.ply", gaussians, up="+z", pad_sh=0)
    numbers = np.frombuffer((tmp_path / "a.ply").read_bytes().split(b"end_header\n")[1], dtype="<f4")
    red, green, blue = [3, 6, 9], [4, 7, 10], [5, 8, 11]
    expected = [1, 2, 3, 0, 0, 0, 0, 1, 2, *red, *green, *blue, 4, -1, -2, -3, 2, 0.25, 0.5, 0.75]
    assert numbers.tolist() == expected


def test_the_up_axis_of_the_header_takes_precedence_over_the_argument(tmp_path):
    gaussians = random_gaussians(degree=0)
    write_ply(tmp_path / "a.ply", gaussians, up="+y", pad_sh=0)
    assert_same_bits(read_ply(tmp_path / "a.ply", up="+z"), gaussians)


@pytest.mark.parametrize(("up", "world"), [("-y", (3, -1, -2)), ("+y", (3, 1, 2)), ("+z", (1, 2, 3))])
def test_the_argument_sets_the_up_axis_of_files_of_other_programs(tmp_path, up, world):
    (tmp_path / "a.ply").write_bytes(hand_made(NAMES, [[1.0, 2.0, 3.0] + [0.0] * 11]))
    assert read_ply(tmp_path / "a.ply", up=up).means[0].tolist() == list(world)


# Files of other programs


def test_order_extra_properties_and_other_types_do_not_matter(tmp_path):
    names = ["red", *reversed(NAMES), "confidence"]
    kinds = ["uchar", "double", *["float"] * 13, "double"]
    rows = [[255, *reversed([float(10 * row + i) for i in range(14)]), 0.5] for row in range(3)]
    (tmp_path / "a.ply").write_bytes(hand_made(names, rows, kinds))
    back = read_ply(tmp_path / "a.ply", up="+z")
    assert back.means.tolist() == [[0, 1, 2], [10, 11, 12], [20, 21, 22]]
    assert back.quats[2].tolist() == [30, 31, 32, 33]
    assert back.opacity_logits.tolist() == [6, 16, 26]


def test_other_elements_before_and_after_are_skipped(tmp_path):
    before = "comment made elsewhere\nobj_info x\nelement camera 2\nproperty uchar id\nproperty double t\n"
    after = "element face 1\nproperty list uchar int vertex_indices\n"
    content = hand_made(NAMES, [[float(i) for i in range(14)]], before=before, after=after)
    header, body = content.split(b"end_header\n")
    (tmp_path / "a.ply").write_bytes(header + b"end_header\n" + b"\0" * 18 + body + b"\3\0\0\0\0")
    assert read_ply(tmp_path / "a.ply", up="+z").opacity_logits.tolist() == [6]


def rewritten(path: Path, version: str) -> None:
    """Write a file of this project again, in another encoding and without its comments."""
    header, body = path.read_bytes().split(b"end_header\n", maxsplit=1)
    lines = [line for line in header.decode().splitlines() if not line.startswith("comment")]
    lines[1] = f"format {version}"
    numbers = np.frombuffer(body, dtype="<f4").reshape(-1, sum(line.startswith("property") for line in lines))
    if version == "ascii 1.0":
        content = "".join(
            " ".join(f"{number:.9g}" for number in row) + "\n" for row in numbers.tolist()
        ).encode()
    else:
        content = numbers.astype(">f4").tobytes()
    path.write_bytes("\n".join([*lines, "end_header", ""]).encode() + content)


@pytest.mark.parametrize("version", ["ascii 1.0", "binary_big_endian 1.0"])
@pytest.mark.parametrize("degree", [0, 3])
def test_every_encoding_gives_the_same_bits(tmp_path, version, degree):
    gaussians = random_gaussians(degree=degree)
    write_ply(tmp_path / "a.ply", gaussians, up="+z", pad_sh=0)
    rewritten(tmp_path / "a.ply", version)
    assert_same_bits(read_ply(tmp_path / "a.ply", up="+z"), gaussians)


@pytest.mark.parametrize("ending", ["\n", "\r\n", "  \n\n \t\n"])
def test_text_may_have_blanks_empty_lines_other_elements_and_no_last_line_break(tmp_path, ending):
    lines = ["ply", "format ascii 1.0", "element camera 2", "property uchar id", "element nothing 3"]
    lines += [
        "element vertex 2",
        *(f"property double {name}" for name in reversed(NAMES)),
        "property char label",
    ]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    rows = [" ".join(str(float(10 * row + i)) for i in reversed(range(14))) + " -7" for row in range(2)]
    content = ending.join([*lines, "1", "2", *rows, "3 0 1 1"])
    (tmp_path / "a.ply").write_text(content, newline="")
    back = read_ply(tmp_path / "a.ply", up="+z")
    assert back.means.tolist() == [[0, 1, 2], [10, 11, 12]]
    assert back.quats.tolist() == [[10, 11, 12, 13], [20, 21, 22, 23]]


def as_text(*rows: str, kinds: str = "float", count: int | None = None) -> bytes:
    lines = ["ply", "format ascii 1.0", f"element vertex {len(rows) if count is None else count}"]
    lines += [f"property {kinds} {name}" for name in NAMES]
    return "\n".join([*lines, "end_header", *rows, ""]).encode("latin-1")


ROW = "0 1 2 3 4 5 6 7 8 9 10 11 12 13"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (as_text(ROW, ROW[:-3]), "14 columns but 13"),
        (as_text(ROW + " 1", ROW + " 1"), "14 columns but 15"),
        (as_text(ROW, ROW.replace("5", "five")), "could not convert string 'five'"),
        (as_text(ROW, ROW, count=3), "truncated: the header promises 3 .* holds 2"),
        (as_text(ROW, ROW, count=999999999999999), "truncated: the header promises .* holds 2"),
        (as_text(ROW, ROW, count=1), "longer than its header promises"),
        (as_text(ROW, ROW.replace("5", "nan")), "NaN or infinity"),
        (as_text(ROW, ROW.replace("5", "9" * 400)), "NaN or infinity"),
        (as_text(ROW.replace("5", "-1"), kinds="uchar"), "could not convert string '-1'"),
        (as_text(ROW.replace("5", "1.5"), kinds="int"), r"could not convert string '1\.5'"),
        (as_text(ROW, ROW.replace("5", "\xe9")), "could not convert"),
    ],
)
def test_damaged_text_is_one_message(tmp_path, content, message):
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(UserError, match=rf"a\.ply: .*{message}.* Try: another file$"):
        read_ply(tmp_path / "a.ply")


def test_infinite_opacities_of_other_programs_mean_zero_and_one(tmp_path):
    rows = [[0.0] * 14 for _ in range(3)]
    for row, opacity in zip(rows, (float("inf"), float("-inf"), 1.5), strict=True):
        row[6] = opacity
    (tmp_path / "a.ply").write_bytes(hand_made(NAMES, rows))
    back = read_ply(tmp_path / "a.ply")
    assert back.opacities.tolist() == pytest.approx([1, 0, torch.tensor(1.5).sigmoid().item()], abs=1e-8)
    assert back.opacity_logits[2] == 1.5


def test_missing_properties_are_named(tmp_path):
    (tmp_path / "a.ply").write_bytes(hand_made(["x", "y", "z", "opacity"], []))
    with pytest.raises(UserError, match=r"no properties f_dc_0.*rot_3.*scale_0"):
        read_ply(tmp_path / "a.ply")


@pytest.mark.parametrize("rest", [1, 10, 72])
def test_a_number_of_rest_coefficients_that_fits_no_degree_is_refused(tmp_path, rest):
    (tmp_path / "a.ply").write_bytes(hand_made([*NAMES, *(f"f_rest_{i}" for i in range(rest))], []))
    with pytest.raises(UserError, match=f"got {rest}\\. Try: "):
        read_ply(tmp_path / "a.ply")


@pytest.mark.parametrize("lost", [1, 67, 68, 5 * 68])
def test_a_truncated_body_is_refused_with_the_counts(tmp_path, lost):
    write_ply(tmp_path / "a.ply", random_gaussians(n=5, degree=0), up="-y", pad_sh=0)
    content = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(content[:-lost])
    with pytest.raises(UserError, match=f"truncated: the header promises 5 .* holds {(5 * 68 - lost) // 68}"):
        read_ply(tmp_path / "a.ply")


def test_a_truncated_header_is_a_user_error(tmp_path):
    write_ply(tmp_path / "a.ply", random_gaussians(n=1, degree=0), up="-y", pad_sh=0)
    content = (tmp_path / "a.ply").read_bytes()
    for length in range(0, content.index(b"end_header\n") + len(b"end_header\n"), 7):
        (tmp_path / "b.ply").write_bytes(content[:length])
        with pytest.raises(UserError):
            read_ply(tmp_path / "b.ply")


# Independent readers


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_plyfile_reads_the_same_numbers(tmp_path, degree):
    plyfile = pytest.importorskip("plyfile")
    gaussians = random_gaussians(degree=degree)
    write_ply(tmp_path / "a.ply", gaussians, up="+z", pad_sh=0)
    vertices = plyfile.PlyData.read(str(tmp_path / "a.ply"))["vertex"]

    def columns(prefix, size):
        return np.stack([vertices[f"{prefix}{i}"] for i in range(size)], axis=1)

    assert np.array_equal(np.stack([vertices["x"], vertices["y"], vertices["z"]], axis=1), gaussians.means)
    assert np.array_equal(columns("scale_", 3), gaussians.log_scales)
    assert np.array_equal(columns("rot_", 4), gaussians.quats)
    assert np.array_equal(vertices["opacity"], gaussians.opacity_logits)
    assert np.array_equal(columns("f_dc_", 3), gaussians.sh[:, 0])
    for channel in range(3):
        for k in range(1, gaussians.sh.shape[1]):
            name = f"f_rest_{channel * (gaussians.sh.shape[1] - 1) + k - 1}"
            assert np.array_equal(vertices[name], gaussians.sh[:, k, channel])


# Writing


def test_gradients_and_double_precision_are_written_as_float32(tmp_path):
    gaussians = random_gaussians(degree=0)
    tracked = gaussians.to(torch.float64).map(lambda tensor: tensor.requires_grad_())
    write_ply(tmp_path / "a.ply", tracked, up="-y", pad_sh=0)
    assert_same_bits(read_ply(tmp_path / "a.ply"), gaussians)


@pytest.mark.parametrize("name", ["means", "log_scales", "quats", "opacity_logits", "sh"])
def test_numbers_that_are_not_finite_are_refused(tmp_path, name):
    for value, up in ((float("nan"), "-y"), (float("inf"), "+z"), (float("-inf"), "-y")):
        gaussians = random_gaussians(n=5, degree=1)
        gaussians.tensors()[name].view(5, -1)[1:3, -1] = value
        write_ply(tmp_path / "a.ply", gaussians, up=up, pad_sh=0)
        with pytest.raises(UserError, match="got NaN or infinity"):
            read_ply(tmp_path / "a.ply")


def test_a_double_that_is_no_float_is_refused_without_a_warning(tmp_path, recwarn):
    content = hand_made(NAMES, [[float(i) for i in range(14)]]).replace(b"float x\n", b"double x\n")
    header, body = content.split(b"end_header\n")
    body = np.float64(1e300).tobytes() + body[4:]
    (tmp_path / "a.ply").write_bytes(header + b"end_header\n" + body)
    with pytest.raises(UserError, match="NaN or infinity"):
        read_ply(tmp_path / "a.ply")
    assert not recwarn.list


def header_of(*lines: str, body: bytes = b"") -> bytes:
    return "\n".join(["ply", *lines, "end_header", ""]).encode() + body


VERTEX = [f"property float {name}" for name in NAMES]
FORMAT_LINE = "format binary_little_endian 1.0"
HOSTILE = {
    "nothing": b"",
    "a picture": b"\x89PNG\r\n",
    "no elements": header_of(FORMAT_LINE),
    "an unknown up axis": header_of(FORMAT_LINE, "comment cadam3d up=sideways", "element vertex 0", *VERTEX),
    "a property twice": header_of(FORMAT_LINE, "element vertex 0", *VERTEX, "property float x"),
    "a list among the vertices": header_of(
        FORMAT_LINE, "element vertex 0", *VERTEX, "property list uchar int neighbours"
    ),
    "a count of 5000 digits": header_of(FORMAT_LINE, "element vertex " + "9" * 5000, *VERTEX),
    "a count of 15 digits": header_of(FORMAT_LINE, "element vertex " + "9" * 15, *VERTEX),
    "a negative count": header_of(FORMAT_LINE, "element vertex -1", *VERTEX),
    "a huge element before zero rows": header_of(
        FORMAT_LINE, "element a " + "9" * 15, "property double t", "element vertex 0", *VERTEX
    ),
    "a huge number before one row": header_of(
        FORMAT_LINE, "element a " + "9" * 5000, "property double t", "element vertex 1", *VERTEX
    ),
    "no format": header_of("element vertex 0", *VERTEX),
    "the format twice": header_of(FORMAT_LINE, FORMAT_LINE, "element vertex 0", *VERTEX),
    "a property before any element": header_of(FORMAT_LINE, "property float x", "element vertex 0", *VERTEX),
    "an element twice": header_of(FORMAT_LINE, "element vertex 0", *VERTEX, "element vertex 9"),
    "a list before the vertices": header_of(
        FORMAT_LINE, "element face 1", "property list uchar int i", "element vertex 0", *VERTEX
    ),
    "a line of 64 kB": header_of(FORMAT_LINE, "comment " + "x" * (1 << 16), "element vertex 0", *VERTEX),
    "bytes after the last row": header_of(FORMAT_LINE, "element vertex 0", *VERTEX, body=b"more"),
    "a word that is not ASCII": header_of(FORMAT_LINE, "element vertex \u0661", *VERTEX),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_header_is_one_message(tmp_path, name):
    (tmp_path / "a.ply").write_bytes(HOSTILE[name])
    with pytest.raises(UserError, match=r"a\.ply") as caught:
        read_ply(tmp_path / "a.ply")
    assert len(str(caught.value)) < 300
