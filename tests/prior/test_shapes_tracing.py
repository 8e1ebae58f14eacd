"""Stored traces and arrays: the same bits, computed once, and no errors if nothing can be stored."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from cadam3d.compiled.library import find_compiler
from cadam3d.core.cameras import Cameras, turntable
from cadam3d.io.cache import TRACES
from cadam3d.prior.shapes import prior, tracing
from cadam3d.prior.shapes.scene import Scene, build
from cadam3d.prior.shapes.tracer import Layers
from cadam3d.prior.shapes.tracing import Tracer, tracer_for

FLOATS = {"device": torch.device("cpu"), "dtype": torch.float32}


def scene_of(prompt: str) -> Scene:
    return build(prompt).to(**FLOATS)


def cameras(size: int = 24, elevation_deg: float = 15.0) -> Cameras:
    return turntable(2, elevation_deg=elevation_deg, distance=3.0, fov_y_deg=45.0, size=size)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch) -> Path:
    monkeypatch.setenv(TRACES, str(tmp_path / "traces"))
    return tmp_path / "traces"


@pytest.fixture
def traced(monkeypatch) -> list[int]:
    """A list with one entry for each call of the tracer."""
    calls: list[int] = []

    def counting(setting: str, cameras: Cameras) -> Tracer:
        chosen = tracer_for(setting, cameras)

        def count(scene: Scene, cameras: Cameras, samples: int) -> Layers:
            calls.append(samples)
            return chosen.trace(scene, cameras, samples)

        return replace(chosen, trace=count)

    monkeypatch.setattr(tracing, "tracer_for", counting)
    return calls


def trace(scene: Scene, cameras: Cameras, samples: int) -> Layers:
    return tracer_for("auto", cameras).trace(scene, cameras, samples)


def same(one: Layers, other: Layers) -> bool:
    return torch.equal(one.alpha, other.alpha) and torch.equal(one.paints, other.paints)


@pytest.mark.parametrize("samples", [1, 2, 3])
@pytest.mark.parametrize("prompt", ["a robot", "a cube", "three red and white spotted balls under a tree"])
def test_a_cached_trace_is_bit_identical(prompt, samples, folder, traced) -> None:
    expected = trace(scene_of(prompt), cameras(), samples)
    first = tracing.shared_trace(scene_of(prompt), cameras(), samples)
    second = tracing.shared_trace(scene_of(prompt), cameras(), samples)
    assert len(traced) == 1
    assert same(first, expected)
    assert same(second, expected)
    assert second.paints.dtype == torch.float32


@pytest.mark.parametrize(
    "other",
    [
        lambda scene, views, samples: (scene_of("a snowman"), views, samples),
        lambda scene, views, samples: (scene_of("a red and white striped cube"), views, samples),  # a pattern
        lambda scene, views, samples: (scene, cameras(elevation_deg=15.001), samples),
        lambda scene, views, samples: (scene, cameras(size=26), samples),
        lambda scene, views, samples: (scene, replace(views, width=26), samples),
        lambda scene, views, samples: (scene, views.index(slice(0, 1)), samples),
        lambda scene, views, samples: (scene, views, 2),
    ],
    ids=["object", "pattern", "place", "size", "width", "views", "samples"],
)
def test_a_trace_is_repeated_if_anything_changes_the_image(other, folder, traced) -> None:
    first = (scene_of("a red and white checkered cube"), cameras(), 1)
    tracing.shared_trace(*first)
    assert same(tracing.shared_trace(*other(*first)), trace(*other(*first)))
    assert len(traced) == 2


def test_scenes_that_differ_in_colour_share_a_trace(folder, traced) -> None:
    for prompt in ("a red cube", "a blue cube"):
        tracing.shared_trace(scene_of(prompt), cameras(), 1)
    assert len(traced) == 1


def test_every_tracer_has_its_own_files(folder) -> None:
    """The last bits may differ, and a trace must not depend on the runs before it."""
    settings = ["torch", "native"] if find_compiler() else ["torch"]
    for setting in settings:
        tracing.shared_trace(scene_of("a cube"), cameras(), 1, setting)
    assert len(list(folder.iterdir())) == len(settings)


@pytest.mark.parametrize("damage", [b"", b"no array at all"], ids=["cut", "other"])
def test_a_damaged_file_is_replaced_by_a_new_trace(damage, folder, traced) -> None:
    given = (scene_of("a cube"), cameras(), 1)
    expected = tracing.shared_trace(*given)
    [file] = folder.iterdir()
    file.write_bytes(damage or file.read_bytes()[:-9])
    assert same(tracing.shared_trace(*given), expected)
    assert same(tracing.shared_trace(*given), expected)
    assert len(traced) == 2


@pytest.mark.parametrize("trouble", ["a file in its place", "a full disk"])
def test_tracing_works_if_nothing_can_be_stored(trouble, folder, monkeypatch) -> None:
    if trouble == "a full disk":
        monkeypatch.setattr(tracing, "SPARE", 2**62)
    else:
        folder.write_text("")
    given = (scene_of("a cube"), cameras(), 1)
    for _ in range(2):
        assert same(tracing.shared_trace(*given), trace(*given))
    assert folder.is_file() or list(folder.iterdir()) == []


def test_without_the_variable_nothing_is_written(tmp_path, monkeypatch) -> None:
    monkeypatch.delenv(TRACES, raising=False)
    monkeypatch.chdir(tmp_path)
    tracing.shared_trace(scene_of("a cube"), cameras(), 1)
    assert list(tmp_path.iterdir()) == []


# --- the census -------------------------------------------------------------------------------------------


@pytest.fixture
def cache(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "cadam3d" / "shapes"


def census() -> dict[str, torch.Tensor]:
    return vars(prior.take_census.__wrapped__(4, "auto"))


def test_the_second_process_reads_the_bits_of_the_first(cache, monkeypatch) -> None:
    made = census()
    monkeypatch.setattr(prior, "_measure", lambda size, tracer: pytest.fail("the arrays were stored"))
    assert all(torch.equal(found, made[name]) for name, found in census().items())
    assert [path.name[:9] for path in cache.iterdir()] == ["census-4-"]


def test_another_number_of_threads_makes_another_file(cache, monkeypatch) -> None:
    census()
    monkeypatch.setattr(torch, "get_num_threads", lambda: 77)
    census()
    assert len(list(cache.iterdir())) == 2
