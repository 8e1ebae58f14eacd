"""The native tracer has the hits and the light of the one in torch, and patterns up to a few samples."""

import ctypes
import random
import re
from dataclasses import replace

import pytest
import torch

from cadam3d.compiled import library as build_module
from cadam3d.compiled.library import FLAGS, SIMD, build, find_compiler
from cadam3d.core.cameras import Cameras, fitting_distance, turntable
from cadam3d.core.errors import UserError
from cadam3d.prior.shapes import ShapesPrior, native_tracer, solids
from cadam3d.prior.shapes import scene as scenes
from cadam3d.prior.shapes.native_tracer import SOURCES, load_tracer, trace_natively, tracer_library
from cadam3d.prior.shapes.objects import Coat, Part, known_objects, known_primitives
from cadam3d.prior.shapes.scene import PATTERN_NAMES, Scene, compile_scene
from cadam3d.prior.shapes.solids import KINDS, Solid
from cadam3d.prior.shapes.tracer import Layers, trace
from cadam3d.prior.shapes.tracing import find_tracer, tracer_for
from cadam3d.prior.shapes.words import COLOURS, NUMBERS, PATTERNS, SIZES, STRETCHES
from cadam3d.prior.truth import ShapesTruth

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C++ compiler")
CPU = torch.device("cpu")
# One solid of every kind.
SOLIDS = (
    solids.ball(0.5),
    solids.box(0.8, 0.5, 0.6),
    solids.frustum(0.5, 0.2, 0.8),
    solids.tube(0.5, 0.3, 0.5),
    solids.torus(0.4, 0.15),
    solids.arc(0.4, 0.12, 110),
    solids.capsule(0.2, 0.9),
    solids.star(0.6, 0.25, 0.3),
    solids.pyramid(0.8, 0.7, 0.9),
    solids.gable(0.8, 0.7, 0.6),
    solids.tetrahedron(0.6),
    solids.octahedron(0.5, 0.4, 0.6),
)


@pytest.fixture(scope="module")
def library() -> ctypes.CDLL:
    if find_compiler() is None:
        pytest.skip("no C++ compiler")
    return load_tracer()[1]


def scene_of(*parts: tuple[Solid, str]) -> Scene:
    coats = [Coat(first, "white", pattern) for first, (_, pattern) in zip(COLOURS, parts, strict=False)]
    painted = [Part(solid, coat) for (solid, _), coat in zip(parts, coats, strict=True)]
    return compile_scene(tuple(painted)).to(CPU, torch.float32)


def build_scene(prompt: str) -> Scene:
    return scenes.build(prompt).to(CPU, torch.float32)


def views(count: int = 2, size: int = 26, elevation_deg: float = 20.0) -> Cameras:
    distance = fitting_distance(40.0)
    return turntable(count, elevation_deg=elevation_deg, distance=distance, fov_y_deg=40.0, size=size)


def turned(solid: Solid, stretched: bool) -> Solid:
    placed = solid.turned("x", 35).turned("z", 25).at(0.05, -0.1, 0.08)
    return placed.stretched(1.2, 0.7, 1.1) if stretched else placed


def kinds_scenes(pattern: str) -> list[Scene]:
    return [scene_of((turned(solid, bool(i % 2)), pattern)) for i, solid in enumerate(SOLIDS)]


def changed_pixels(ours: Layers, expected: Layers) -> int:
    """Return the number of pixels with another paint; fails if a ray hits something else or another light."""
    assert torch.equal(ours.alpha, expected.alpha)
    # The light does not depend on the paint, and the order of the sums differs between the tracers.
    torch.testing.assert_close(ours.paints.sum(-1), expected.paints.sum(-1), rtol=0, atol=1e-6)
    return int(((ours.paints - expected.paints).abs().amax(-1) > 1e-6).sum())


def test_every_kind_is_in_this_file() -> None:
    assert [solid.kind for solid in SOLIDS] == list(KINDS)


@pytest.mark.parametrize("pattern", PATTERN_NAMES)
@pytest.mark.parametrize("samples", [1, 2])
def test_every_kind_equals_torch(pattern: str, samples: int, library) -> None:
    changed = [
        changed_pixels(trace_natively(library, scene, views(), samples), trace(scene, views(), samples))
        for scene in kinds_scenes(pattern)
    ]
    assert sum(changed) <= (0 if pattern == "plain" else 2)


def test_every_object_equals_torch(library) -> None:
    changed = []
    for number, name in enumerate((*known_primitives(), *known_objects())):
        view = views(1, elevation_deg=(-40.0, 10.0, 65.0)[number % 3])
        pattern = PATTERN_NAMES[number % len(PATTERN_NAMES)]
        scene = build_scene(f"a {pattern} {name}")
        pixels = changed_pixels(trace_natively(library, scene, view, 2), trace(scene, view, 2))
        changed.append(pixels)
        assert pattern != "plain" or pixels == 0
    assert sum(changed) <= 2


def sentence(rng: random.Random) -> str:
    """Return a random sentence with one or two relations."""

    def phrase() -> str:
        words = [rng.choice([*NUMBERS][:3] if rng.random() < 0.3 else ["a"])]
        for group in (SIZES, STRETCHES, COLOURS, PATTERNS):
            words += [rng.choice([*group])] if rng.random() < 0.4 else []
        noun = rng.choice([*known_primitives(), *known_objects()])
        return " ".join([*words, noun])

    relations = ("on", "under", "above", "next to", "in front of", "behind")
    words = [phrase()]
    for _ in range(rng.choice([1, 1, 2])):
        words += [rng.choice(relations), phrase()]
    return " ".join(words)


def test_random_sentences_equal_torch(library) -> None:
    rng, changed = random.Random(0), 0
    for _ in range(6):
        scene = build_scene(sentence(rng))
        changed += changed_pixels(trace_natively(library, scene, views(1), 3), trace(scene, views(1), 3))
    assert changed <= 2


def camera(distance: float, fov_y_deg: float, **changes: int) -> Cameras:
    view = turntable(3, elevation_deg=15.0, distance=distance, fov_y_deg=fov_y_deg, size=20)
    return replace(view, **changes)


@pytest.mark.parametrize(
    "view",
    [
        pytest.param(camera(3.0, 40.0, width=33), id="wide"),
        pytest.param(camera(3.0, 40.0, height=31, width=9), id="high"),
        pytest.param(camera(3.0, 40.0, height=1, width=1), id="one pixel"),
        pytest.param(camera(0.8, 90.0), id="inside the ball"),
        pytest.param(camera(0.3, 100.0), id="inside the object"),
        pytest.param(camera(40.0, 4.0), id="far away"),
        pytest.param(camera(3.0, 150.0), id="wide angle"),
    ],
)
def test_every_camera_equals_torch(view: Cameras, library) -> None:
    scene = build_scene("a robot next to a striped tree")
    assert changed_pixels(trace_natively(library, scene, view, 3), trace(scene, view, 3)) == 0


def test_a_camera_that_looks_away_sees_nothing(library) -> None:
    view = views()
    flip = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    layers = trace_natively(
        library, build_scene("a cube"), replace(view, world_to_camera=flip @ view.world_to_camera), 2
    )
    assert float(layers.alpha.abs().max()) == float(layers.paints.abs().max()) == 0.0


def test_the_later_of_two_parts_at_the_same_place_is_visible(library) -> None:
    twins = scene_of((SOLIDS[1], "plain"), (SOLIDS[1], "plain"))
    expected = trace(twins, views(), 1)
    assert changed_pixels(trace_natively(library, twins, views(), 1), expected) == 0
    first, second = twins.paints[:, 0].tolist()
    assert float(expected.paints[..., first].max()) == 0 < float(expected.paints[..., second].max())


def test_the_bits_do_not_depend_on_the_number_of_threads(library) -> None:
    scene, before = build_scene("a spotted mushroom"), torch.get_num_threads()
    found = []
    try:
        for threads in (1, 2, 3, 64):
            torch.set_num_threads(threads)
            found.append(trace_natively(library, scene, camera(3.0, 40.0, width=33), 3))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(each.alpha, found[0].alpha) for each in found)
    assert all(torch.equal(each.paints, found[0].paints) for each in found)


def test_only_float32_on_the_cpu_is_traced_natively() -> None:
    double = views().to(torch.float64)
    assert tracer_for("auto", double).identity == tracer_for("native", double).identity == "torch"
    if find_compiler():
        names = [tracer_for(setting, views()).identity for setting in ("auto", "native", "torch")]
        assert names[0] == names[1] != names[2] == "torch"


# --- the choice


@pytest.fixture
def no_compiler(monkeypatch, tmp_path):
    """Simulate a machine without compilers and compiled files."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(build_module, "find_compiler", lambda: None)
    find_tracer.cache_clear()
    yield
    find_tracer.cache_clear()


def shapes(tracer: str) -> ShapesPrior:
    from composed import composed

    from cadam3d.build import component

    return component(composed("prior=shapes", "prior.census_size=4", f"prior.tracer={tracer}").prior)


def test_without_a_compiler_auto_is_the_tracer_in_torch(no_compiler) -> None:
    assert find_tracer("auto").identity == "torch"
    priors = [shapes(name) for name in ("auto", "torch")]
    means = [prior.mixture(prior.scene("a cube"), views(), torch.ones(2, 3)).means for prior in priors]
    assert torch.equal(*means)


def test_without_a_compiler_native_is_refused_with_its_key(no_compiler) -> None:
    with pytest.raises(UserError, match=r"^prior\.tracer=native: expected a C\+\+ compiler"):
        shapes("native").embed("a cube", "")
    source = ShapesTruth(samples_per_pixel=1, turns=None, tracer="native")
    with pytest.raises(UserError, match=r"^truth\.tracer=native: expected a C\+\+ compiler"):
        source.of("a cube", shapes("torch"))


def test_a_failed_build_is_tried_once(no_compiler, monkeypatch) -> None:
    calls = []
    monkeypatch.setattr(build_module, "find_compiler", lambda: calls.append(1))
    for _ in range(3):
        tracer_for("auto", views())
    assert len(calls) == 1


# --- planted mistakes

# The text before an expression, the expression, and the one that replaces it while the mistake is active.
MUTANTS = {
    "a tie goes to the first part": (
        "is_hit, ",
        "less_equal(t, nearest.reached)",
        "greater(nearest.reached, t)",
    ),
    "a ray stops in front of its hit": ("limit = ", "nearest.limit()", "nearest.reached - 0.3f"),
    "a part behind the nearest hit wins": ("nearest.part = select(", "is_nearest", "is_hit"),
    "a march that stops early": ("step = 0; step < ", "TRACE_MARCH_STEPS", "8"),
    "a graze in the middle of a march": ("float(", "is_last", "true"),
    "no speed in stretched solids": ("speed = ", "inverse_root(dot(direction, direction))", "spread(1.0f)"),
    "normals are mapped like points": (
        "unit(",
        "transposed_product(to_local, normal)",
        "product(to_local, normal)",
    ),
    "the light has no wrap": ("normal) + float(", "TRACE_WRAP", "0"),
    "the sky is below": ("(0.5f + ", "0.5f * normal.z", "-0.5f * normal.z"),
    "a frustum on its head": ("middle + ", "slope * p.z", "-slope * p.z"),
    "an arc without ends": ("is_beyond = ", "greater(x * cosine, p.y * sine)", "simd::none()"),
    "a capsule without ends": ("beyond = ", "max(absolute(p.z) - half, Floats{})", "Floats{}"),
    "a star with one fold": ("p.z;\n    for (int i = ", "0", "1"),
    "a wrong number of stripes": ("(turn + 1.0f) * ", "8.0f", "9.0f"),
    "spots are not staggered": ("around + ", "0.5f", "0.0f"),
    "one spot is missing": ("spot < ", "TRACE_SPOTS", "TRACE_SPOTS - 1"),
    "faces on the border of a cell": ("inner{", "0.999f", "1.0f"),
    "bands on a ball by height": (
        "asin(Floats x) { return ",
        "atan2(x, simd::root((1.0f - x) * (1.0f + x)))",
        "x",
    ),
    "the left half begins elsewhere": ("x), float(", "PI", "3.1"),
    "a sample in the wrong row": ("(row + ", "lane / BLOCK_COLUMNS", "0"),
    "coverage above one": ("std::fmin(job.alpha[at], ", "1.0f", "2.0f"),
}


@pytest.fixture(scope="module")
def mutants(tmp_path_factory) -> ctypes.CDLL:
    """Return the tracer with all mistakes planted and switched off; ``active_mutant`` switches one on."""
    if find_compiler() is None:
        pytest.skip("no C++ compiler")
    folder = tmp_path_factory.mktemp("mutants")
    text = SOURCES[0].read_text(encoding="utf-8")
    for number, (before, original, wrong) in enumerate(MUTANTS.values(), start=1):
        assert text.count(before + original) == 1, original
        text = text.replace(before + original, f"{before}(active_mutant == {number} ? {wrong} : {original})")
    switch = 'extern "C" __attribute__((visibility("default"))) int active_mutant;\nint active_mutant = 0;\n'
    source = folder / "trace.cpp"
    source.write_text(switch + text, encoding="utf-8")
    changed = replace(tracer_library(), sources=(source, SIMD), flags=(*FLAGS, "-O1"))
    # Without flags for this machine, vectors are narrower than those of the other tests.
    return ctypes.CDLL(str(build(changed, folder / "cache", machine_flags=((),))))


@pytest.fixture(scope="module")
def judged() -> list[tuple[Scene, Cameras, int, Layers]]:
    """Return scenes that together show every kind, every pattern and several parts, with their images."""
    cases = [(scene, views(1), 1) for pattern in PATTERN_NAMES for scene in kinds_scenes(pattern)]
    cases.append((scene_of((SOLIDS[1], "plain"), (SOLIDS[1], "plain")), views(1), 1))
    cases.append((scene_of((solids.box(0.8, 0.8, 0.8), "checkered")), views(1), 1))
    cases.append((scene_of((SOLIDS[0], "spotted")), views(1, elevation_deg=-60.0), 1))
    cases.append((build_scene("a lighthouse next to a spotted cube"), views(1, size=27), 3))
    # The rounded shares of a pixel add up to more than one.
    cases.append((build_scene("a sphere"), views(1, size=8), 6))
    return [(scene, view, samples, trace(scene, view, samples)) for scene, view, samples in cases]


def test_every_planted_mistake_is_noticed(mutants, judged) -> None:
    active = ctypes.c_int.in_dll(mutants, "active_mutant")

    def agrees(number: int) -> bool:
        active.value = number
        changed = 0
        for scene, view, samples, expected in judged:
            try:
                changed += changed_pixels(trace_natively(mutants, scene, view, samples), expected)
            except AssertionError:
                return False
        return changed <= 2

    assert agrees(0)
    assert [name for number, name in enumerate(MUTANTS, start=1) if agrees(number)] == []


def test_the_structure_mirrors_the_one_in_the_source() -> None:
    text = SOURCES[0].read_text(encoding="utf-8")
    body = text[text.index("struct Job {") :].partition("{")[2].partition("};")[0]
    code = re.sub(r"//.*|\*", "", body)
    names = [words.split()[-1] for words in re.split("[,;]", code) if words.strip()]
    assert names == [name for name, _ in native_tracer._Job._fields_]
