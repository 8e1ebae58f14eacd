"""Exporters of Gaussians: file names, axes, and wrong values that name their key."""

import pytest
from formats import asset, errors, gaussforge_reads, likeness_db, random_gaussians

from cadam3d.core import checks
from cadam3d.core.errors import UserError
from cadam3d.exporter.base import AssetExporter
from cadam3d.exporter.compressed_ply import CompressedPlyExporter
from cadam3d.exporter.glb import GlbExporter
from cadam3d.exporter.ksplat import KsplatExporter
from cadam3d.exporter.ply import PlyExporter
from cadam3d.exporter.sog import SogExporter
from cadam3d.exporter.splat import SplatExporter
from cadam3d.exporter.spz import SpzExporter
from cadam3d.io.asset_file import read_gaussians
from cadam3d.io.frames import UPS, file_to_world

EXPORTERS = {
    "asset.ply": (PlyExporter, {"pad_sh": 0}),
    "asset.compressed.ply": (CompressedPlyExporter, {}),
    "asset.splat": (SplatExporter, {}),
    "asset.spz": (SpzExporter, {"version": 3}),
    "asset.glb": (GlbExporter, {"colors": "display"}),
    "asset.sog": (SogExporter, {}),
    "asset.ksplat": (KsplatExporter, {}),
}

ALL = {"count": None, "fraction": None, "simplify": "merge"}


def never_renders(cameras, background):
    raise AssertionError("a file of Gaussians needs no picture")


def built(name: str, up: str = "-y", **changed) -> AssetExporter:
    kind, settings = EXPORTERS[name]
    return kind(up=up, **{**ALL, **settings, **changed})


@pytest.mark.parametrize("name", EXPORTERS)
def test_each_exporter_writes_its_file_and_nothing_else(tmp_path, name):
    assert built(name).export(random_gaussians(5), never_renders, tmp_path) == [tmp_path / name]
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("name", ["asset.ply", "asset.compressed.ply", "asset.splat", "asset.spz"])
@pytest.mark.parametrize("up", UPS)
def test_the_file_has_the_chosen_axes(tmp_path, name, up):
    built(name, up).export(asset(), never_renders, tmp_path)
    assert likeness_db(read_gaussians(tmp_path / name, up=up)) > 38


def test_a_ply_has_padded_spherical_harmonics(tmp_path):
    made = built("asset.ply", pad_sh=3)
    [path] = made.export(random_gaussians(5), never_renders, tmp_path)
    assert read_gaussians(path).sh_degree == made.contents(path, random_gaussians(5)).sh_degree == 3


def test_spz_has_the_chosen_version(tmp_path):
    gaussians = random_gaussians(20)
    built("asset.spz", version=3).export(gaussians, never_renders, tmp_path)
    assert (tmp_path / "asset.spz").read_bytes()[:2] == b"\x1f\x8b"
    pytest.importorskip("gaussforge")
    built("asset.spz", "+z", version=4).export(gaussians, never_renders, tmp_path)
    content = (tmp_path / "asset.spz").read_bytes()
    assert content[:8] == b"NGSP\4\0\0\0"
    assert errors(file_to_world(gaussforge_reads(content, "spz"), "+z"), gaussians)["means"] < 2e-4


@pytest.mark.parametrize(
    ("name", "settings", "key"),
    [
        ("asset.sog", {}, "exporter.sog"),
        ("asset.ksplat", {}, "exporter.ksplat"),
        ("asset.spz", {"version": 4}, "exporter.spz.version"),
    ],
)
def test_a_missing_package_is_reported_before_anything_runs(monkeypatch, name, settings, key):
    monkeypatch.setattr(checks, "find_spec", lambda _: None)
    with pytest.raises(UserError) as caught:
        built(name, **settings)
    assert str(caught.value) == f"{key}: needs gaussforge. Try: pip install '.[formats]'"


@pytest.mark.parametrize(
    ("name", "highest"), [("asset.splat", 0), ("asset.ksplat", 2), ("asset.spz", 3), ("asset.glb", 3)]
)
def test_what_a_format_cannot_hold_becomes_a_note(name, highest):
    for degree in range(4):
        omission = built(name).omission(random_gaussians(2, degree=degree))
        assert (omission is None) == (degree <= highest)
    if highest < 3:
        assert f"{name} has SH degree {highest}" in omission
