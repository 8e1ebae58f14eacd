"""Laws of the ply initializer: assets are read back unchanged, and points become Gaussians."""

import struct

import pytest
import torch
import trimesh

from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.sh import SH_C0, evaluate_sh
from cadam3d.initializer.ply import Ply
from cadam3d.io.compressed_ply import write_compressed_ply
from cadam3d.io.ply import write_ply
from cadam3d.io.splat import write_splat
from cadam3d.io.spz import write_spz

CPU = torch.device("cpu")


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def ply(path, **changes) -> Ply:
    usual = {
        "path": str(path),
        "up": None,
        "turn_deg": 0,
        "radius": None,
        "factor": None,
        "lift": 0.0,
        "count": None,
        "sh_degree": None,
        "replicate": 1,
        "replicate_radius": 0.05,
        "replicate_law": "even",
        "scale": 0.02,
        "scale_law": "mean",
        "opacity": 0.1,
        "color": [0.2, 0.4, 0.6],
    }
    return Ply(**{**usual, **changes})


def build(path, seed: int = 0, **changes) -> Gaussians:
    return ply(path, **changes).build("anything", seeded(seed), CPU)


def rgb(made: Gaussians) -> torch.Tensor:
    return 0.5 + SH_C0 * made.sh[:, 0]


# --- an asset of Gaussians


def some_gaussians(n: int = 60, degree: int = 1) -> Gaussians:
    draw = seeded()

    def normal(*shape):
        return torch.randn(*shape, generator=draw)

    sh = normal(n, (degree + 1) ** 2, 3)
    return Gaussians(normal(n, 3), normal(n, 3), normal(n, 4), normal(n), sh)


def saved(tmp_path, gaussians: Gaussians, up: str = "-y"):
    write_ply(tmp_path / "asset.ply", gaussians, up=up, pad_sh=0)
    return tmp_path / "asset.ply"


def assert_equal(made: Gaussians, wanted: Gaussians) -> None:
    for name, tensor in wanted.tensors().items():
        assert torch.equal(made.tensors()[name], tensor), name


@pytest.mark.parametrize("up", ["-y", "+y", "+z"])
@pytest.mark.parametrize("degree", [0, 1])
def test_our_assets_are_read_back_unchanged_with_any_up_axis(tmp_path, up, degree):
    asset = some_gaussians(degree=degree)
    assert_equal(build(saved(tmp_path, asset, up), up="+z"), asset)


@pytest.mark.parametrize(
    ("name", "write"),
    [("a.compressed.ply", write_compressed_ply), ("a.splat", write_splat), ("a.spz", write_spz)],
)
def test_assets_of_other_formats_are_upright_once_their_axis_is_given(tmp_path, name, write):
    asset = some_gaussians(degree=0)
    write(tmp_path / name, asset, up="+z")
    made = build(tmp_path / name, up="+z")
    assert len(made) == 60
    # Formats change the order of the rows.
    torch.testing.assert_close(made.means.mean(dim=0), asset.means.mean(dim=0), atol=0.001, rtol=0)


@pytest.mark.parametrize("turn_deg", [0, 90, 180, 270])
def test_a_turned_asset_looks_the_same_from_turned_directions(tmp_path, turn_deg):
    asset = some_gaussians(degree=3)
    made = build(saved(tmp_path, asset), turn_deg=turn_deg)
    angle = torch.tensor(torch.pi * turn_deg / 180)
    cos, sin = angle.cos().item(), angle.sin().item()
    rotation = torch.tensor([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    torch.testing.assert_close(made.means, asset.means @ rotation.T, atol=1e-5, rtol=0)
    directions = torch.nn.functional.normalize(torch.randn(60, 3, generator=seeded(1)), dim=-1)
    seen = evaluate_sh(made.sh, directions @ rotation.T)
    torch.testing.assert_close(seen, evaluate_sh(asset.sh, directions), atol=1e-4, rtol=0)
    covariance = made.rotations @ torch.diag_embed(made.scales**2) @ made.rotations.mT
    before = asset.rotations @ torch.diag_embed(asset.scales**2) @ asset.rotations.mT
    torch.testing.assert_close(covariance, rotation @ before @ rotation.T, atol=1e-4, rtol=1e-4)


def test_an_asset_is_scaled_as_a_whole(tmp_path):
    asset = some_gaussians()
    made = build(saved(tmp_path, asset), radius=0.5)
    assert float(made.means.norm(dim=-1).max()) == pytest.approx(0.5)
    sizes = made.scales / asset.scales
    ratio = (made.means[0] - made.means[1]).norm() / (asset.means[0] - asset.means[1]).norm()
    torch.testing.assert_close(sizes, ratio.expand(60, 3))
    assert torch.equal(made.sh, asset.sh)
    assert torch.equal(made.opacity_logits, asset.opacity_logits)
    twice = build(saved(tmp_path, asset), factor=2.0, lift=0.3)
    torch.testing.assert_close(twice.means, 2 * asset.means + torch.tensor([0.0, 0.0, 0.3]))
    torch.testing.assert_close(twice.scales, 2 * asset.scales)


def test_a_cap_selects_random_rows_of_an_asset(tmp_path):
    asset = some_gaussians()
    made = build(saved(tmp_path, asset), count=20)
    rows = [int((asset.means == mean).all(dim=1).nonzero()) for mean in made.means]
    assert rows == sorted(set(rows))
    assert_equal(made, asset.index(torch.tensor(rows)))
    assert not torch.equal(made.means, build(saved(tmp_path, asset), count=20, seed=1).means)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_degree_of_the_colors_can_be_chosen(tmp_path, degree):
    asset = some_gaussians(degree=2)
    made = build(saved(tmp_path, asset, "+z"), sh_degree=degree)
    assert made.sh_degree == degree
    shared = min(made.sh.shape[1], asset.sh.shape[1])
    assert torch.equal(made.sh[:, :shared], asset.sh[:, :shared])
    assert not made.sh[:, shared:].any()


def test_gaussians_are_not_replicated(tmp_path):
    with pytest.raises(UserError, match=r"initializer\.replicate: expected 1, since .* got 20"):
        build(saved(tmp_path, some_gaussians()), replicate=20)


def test_an_empty_asset_is_refused(tmp_path):
    with pytest.raises(UserError, match=r"^initializer\.path: expected finite means"):
        build(saved(tmp_path, some_gaussians(n=0)))


# --- a cloud of points


POINTS = torch.rand(40, 3, generator=seeded(2)) - torch.tensor([0.5, 0.25, 0.75])
COLORS = torch.randint(256, (40, 3), generator=seeded(3))


def point_cloud(folder, layout: str = "binary_little_endian", kind: str = "uchar", names="red green blue"):
    """Write a file as other programs do, without the code under test; without names it has no colours."""
    header = f"ply\nformat {layout} 1.0\nelement vertex 40\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    header += "".join(f"property {kind} {name}\n" for name in names.split()) + "end_header\n"
    colors = COLORS.tolist() if kind == "uchar" else (COLORS / 255).tolist()
    rows = [[*p, *(c if names else [])] for p, c in zip(POINTS.tolist(), colors, strict=True)]
    if layout == "ascii":
        body = "".join(" ".join(map(str, row)) + "\n" for row in rows).encode()
    else:
        codes = "3f" + ({"uchar": "3B", "float": "3f"}[kind] if names else "")
        sign = ">" if "big" in layout else "<"
        body = b"".join(struct.pack(sign + codes, *row) for row in rows)
    path = folder / "points.ply"
    path.write_bytes(header.encode() + body)
    return path


@pytest.mark.parametrize("layout", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("kind", ["uchar", "float"])
def test_points_keep_their_places_and_colors_in_every_layout(tmp_path, layout, kind):
    made = build(point_cloud(tmp_path, layout, kind))
    torch.testing.assert_close(made.means, POINTS)
    torch.testing.assert_close(rgb(made), COLORS / 255)
    torch.testing.assert_close(made.opacities, torch.full((40,), 0.1))
    torch.testing.assert_close(made.scales, torch.full((40, 3), 0.02))
    assert made.sh_degree == 0


def test_points_without_colors_get_the_configured_color(tmp_path):
    made = build(point_cloud(tmp_path, names=""), sh_degree=1)
    torch.testing.assert_close(rgb(made), torch.tensor([[0.2, 0.4, 0.6]]).expand(40, 3))
    assert made.sh_degree == 1


@pytest.mark.parametrize(
    ("up", "world"), [("+z", (0, 1, 2)), ("+y", (2, 0, 1)), (None, (0, 1, 2))], ids=["+z", "+y", "not given"]
)
def test_points_are_upright(tmp_path, up, world):
    torch.testing.assert_close(build(point_cloud(tmp_path), up=up).means, POINTS[:, world])


def test_points_are_scaled_before_they_are_replicated(tmp_path):
    made = build(point_cloud(tmp_path), radius=0.6, replicate=20, replicate_radius=0.01)
    assert len(made) == 800
    centers = made.means.view(40, 20, 3).mean(dim=1)
    assert float(centers.norm(dim=-1).max()) == pytest.approx(0.6, abs=0.01)
    spread = (made.means.view(40, 20, 3) - centers[:, None]).norm(dim=-1)
    assert 0.001 < spread.max() <= 0.02
    torch.testing.assert_close(rgb(made).view(40, 20, 3), (COLORS / 255)[:, None].expand(40, 20, 3))


def test_results_depend_on_the_generator_alone(tmp_path):
    path = point_cloud(tmp_path)
    first, again, other = (build(path, count=10, replicate=3, seed=seed).means for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_points_that_are_not_finite_are_refused(tmp_path):
    path = point_cloud(tmp_path, "ascii")
    path.write_text(path.read_text().replace(str(POINTS.tolist()[0][0]), "nan"))
    with pytest.raises(UserError, match=r"^initializer\.path: expected finite points"):
        build(path)


def test_a_mesh_is_refused_with_the_initializer_to_use(tmp_path):
    trimesh.creation.box().export(tmp_path / "box.ply")
    with pytest.raises(UserError, match=r"which is a mesh\. Try: initializer=mesh$"):
        build(tmp_path / "box.ply")


def test_an_asset_too_large_to_be_measured_is_refused_only_if_it_is_scaled(tmp_path):
    far = 1e25
    huge = some_gaussians(3)
    huge.means[0] = -far
    huge.means[1] = far
    write_ply(tmp_path / "a.ply", huge, up="-y", pad_sh=0)
    assert len(build(tmp_path / "a.ply")) == 3
    with pytest.raises(UserError, match=r"distances below 1e19"):
        build(tmp_path / "a.ply", radius=0.5)
