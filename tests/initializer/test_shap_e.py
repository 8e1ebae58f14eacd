"""Laws of the Shap-E initializer, on a tiny pipeline of the real classes and on handmade meshes."""

import gc

import pytest
import torch

from cadam3d.core.errors import UserError
from cadam3d.core.sh import SH_C0
from cadam3d.initializer.ball import Ball
from cadam3d.initializer.shap_e import KIND, OTHERS, ColoredMesh, ShapE
from cadam3d.io.pretrained import ModelSource, Pretrained

CPU = torch.device("cpu")
BALL = Ball(
    count=30,
    radius=0.5,
    scale=0.1,
    scale_law="mean",
    opacity=0.1,
    sh_degree=0,
    color=[0.5, 0.5, 0.5],
    color_noise=0.1,
)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def shap_e(path: object = "nowhere", **changes) -> ShapE:
    usual = {
        "path": str(path),
        "ids": [],
        "revision": None,
        "variant": None,
        "dtype": "auto",
        "prompt": None,
        "steps": 3,
        "guidance_scale": 15.0,
        "grid_size": 8,
        "turn_deg": 0,
        "radius": 0.9,
        "factor": None,
        "lift": 0.0,
        "count": None,
        "grow_points": 0,
        "grow_distance": 0.01,
        "grow_noise": 0.2,
        "tone": "srgb",
        "color": None,
        "replicate": 1,
        "replicate_radius": 0.05,
        "replicate_law": "even",
        "scale": 0.02,
        "scale_law": "mean",
        "opacity": 0.1,
        "sh_degree": 0,
        "fallback": None,
    }
    return ShapE(**{**usual, **changes})


def rgb_of(gaussians) -> torch.Tensor:
    return 0.5 + SH_C0 * gaussians.sh[:, 0]


# --- from a mesh to Gaussians


def found_by(made: ShapE) -> Pretrained:
    source = ModelSource("initializer", made.path, made.ids, made.revision, made.variant)
    return source.find((KIND,), OTHERS)


def a_mesh() -> ColoredMesh:
    """A square from x = 0 (black) to x = 1 (red) in the plane z = 0, and a blue point."""
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 0.5]])
    rgb = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 0, 0], [0, 0, 0], [0, 0, 1]])
    return ColoredMesh(vertices, torch.tensor([[0, 1, 2], [0, 2, 3]]), rgb)


def settle(seed: int = 0, mesh: ColoredMesh | None = None, **changes):
    return shap_e(**changes).settle(mesh or a_mesh(), seeded(seed), CPU)


def test_vertices_become_gaussians_with_their_colors():
    made = settle(radius=None)
    assert torch.equal(made.means, a_mesh().vertices)
    torch.testing.assert_close(rgb_of(made), a_mesh().rgb)
    torch.testing.assert_close(made.opacities, torch.full((5,), 0.1))


def test_a_factor_keeps_the_origin_of_the_mesh_and_a_lift_raises_it():
    made = settle(radius=None, factor=2.0, lift=0.3)
    torch.testing.assert_close(made.means, 2 * a_mesh().vertices + torch.tensor([0.0, 0.0, 0.3]))
    centred = settle(radius=0.9).means
    torch.testing.assert_close(settle(radius=0.9, lift=-0.2).means, centred - torch.tensor([0.0, 0.0, 0.2]))


def test_one_color_can_replace_those_of_the_model():
    made = settle(color=[0.1, 0.2, 0.3], grow_points=100)
    torch.testing.assert_close(rgb_of(made), torch.tensor([0.1, 0.2, 0.3]).expand(len(made), 3))


def test_a_quarter_turn_moves_the_front_of_shap_e_to_our_front():
    means = settle(radius=None, turn_deg=90).means
    wanted = torch.stack([-a_mesh().vertices[:, 1], a_mesh().vertices[:, 0], a_mesh().vertices[:, 2]], dim=1)
    assert torch.equal(means, wanted)


def test_random_points_of_the_surface_have_its_colors():
    made = settle(radius=None, count=3000)
    assert len(made) == 3000
    assert made.means[:, 2].abs().max() == 0
    torch.testing.assert_close(rgb_of(made)[:, 0], made.means[:, 0], atol=1e-5, rtol=0)
    torch.testing.assert_close(made.means[:, :2].mean(dim=0), torch.tensor([0.5, 0.5]), atol=0.03, rtol=0)


def test_growth_adds_points_near_the_surface_and_keeps_the_surface():
    made = settle(radius=None, count=400, grow_points=20_000, grow_distance=0.05)
    base = settle(radius=None, count=400).means
    assert torch.equal(made.means[:400], base)
    grown = made.means[400:]
    assert len(grown) > 400
    distances = torch.cdist(grown, base)
    assert float(distances.min(dim=1).values.max()) < 0.05
    low, high = base.amin(dim=0), base.amax(dim=0)
    assert ((grown >= low) & (grown <= high)).all()


def test_growth_adds_all_candidates_that_are_near():
    vertices = torch.tensor([[0.0, 0, 0], [1, 1, 1]])
    mesh = ColoredMesh(vertices, torch.tensor([[0, 1, 1]]), torch.zeros(2, 3))
    made = settle(mesh=mesh, radius=None, grow_points=200_000, grow_distance=0.5)
    share = (len(made) - 2) / 200_000
    # The candidates fill an eighth of a ball at each corner.
    assert share == pytest.approx(2 * torch.pi * 0.5**3 / 6, rel=0.05)


def test_grown_points_are_the_color_of_their_neighbour_and_a_little_brighter():
    mesh = a_mesh()
    made = settle(radius=None, grow_points=50_000, grow_distance=0.1, grow_noise=0.2)
    added = slice(len(mesh.vertices), None)
    neighbour = torch.cdist(made.means[added], mesh.vertices).argmin(dim=1)
    brighter = rgb_of(made)[added] - mesh.rgb[neighbour]
    assert rgb_of(made).max() <= 1 + 1e-6
    free = mesh.rgb[neighbour] < 0.5
    assert brighter[free].min() >= -1e-6
    assert brighter[free].max() <= 0.2 + 1e-6
    assert float(brighter[free].mean()) == pytest.approx(0.1, abs=0.01)


def test_points_are_replicated_in_world_units():
    made = settle(radius=0.9, replicate=20, replicate_radius=0.01)
    assert len(made) == 100
    centers = settle(radius=0.9).means
    offsets = made.means.view(5, 20, 3) - centers[:, None]
    assert 0.005 < float(offsets.norm(dim=-1).max()) <= 0.01 + 1e-6


# --- the model


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    for name in ("diffusers", "transformers"):
        pytest.importorskip(name)
    import pipelines

    return {
        surface: pipelines.shap_e(tmp_path_factory.mktemp("shap_e"), surface=surface)
        for surface in (True, False)
    }


def latent(path, seed: int = 0, run_prompt: str = "a corgi", **changes) -> torch.Tensor:
    made = shap_e(path, **changes)
    return made.sample(found_by(made), run_prompt, seeded(seed), CPU)


def test_the_latent_is_that_of_the_pipeline_itself(models):
    from diffusers import ShapEPipeline

    pipeline = ShapEPipeline.from_pretrained(models[True])
    pipeline.set_progress_bar_config(disable=True)
    wanted = pipeline(
        "a corgi", num_inference_steps=3, guidance_scale=15.0, generator=seeded(), output_type="latent"
    ).images
    torch.testing.assert_close(latent(models[True]), wanted)


def test_the_initializers_own_prompt_replaces_that_of_the_run(models):
    cube = latent(models[True], run_prompt="a red cube")
    assert not torch.equal(cube, latent(models[True]))
    assert torch.equal(cube, latent(models[True], prompt="a red cube"))


@pytest.mark.parametrize("dtype", ["float16"])
def test_half_precision_is_nearly_the_same_and_returns_float32(models, dtype):
    half = latent(models[True], dtype=dtype, guidance_scale=1.0)
    assert half.dtype == torch.float32
    whole = latent(models[True], guidance_scale=1.0)
    assert not torch.equal(half, whole)
    torch.testing.assert_close(half, whole, atol=0.05, rtol=0)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_in_half_precision_agrees_with_the_cpu(models):
    asked, cuda = shap_e(models[True]), torch.device("cuda")
    found = found_by(asked)
    there = asked.sample(found, "a corgi", seeded(), cuda)
    assert there.device.type == "cuda"
    torch.testing.assert_close(there.cpu(), latent(models[True]), atol=0.05, rtol=0)
    before = torch.cuda.memory_allocated()
    assert asked.build("a corgi", seeded(), cuda).device.type == "cuda"
    # Only the Gaussians remain in memory, and nothing of the model.
    assert torch.cuda.memory_allocated() <= before + 2**20


def test_the_prompt_becomes_gaussians(models):
    made = shap_e(models[True]).build("a corgi", seeded(), CPU)
    assert len(made) > 100
    assert float(made.means.norm(dim=-1).max()) == pytest.approx(0.9)
    assert rgb_of(made).min() >= -1e-6
    assert rgb_of(made).max() <= 1 + 1e-6
    # An available model gives no note, and the same Gaussians again.
    again = begin(path=models[True], fallback=BALL)
    assert again.note is None
    assert torch.equal(made.means, again.gaussians.means)
    assert torch.equal(made.sh, again.gaussians.sh)


def test_colors_are_those_that_the_model_paints_with(models):
    """The decoder converts its colours to linear light; the initializer must convert them back."""
    asked = shap_e(models[True])
    found = found_by(asked)
    described = asked.sample(found, "a corgi", seeded(), CPU)
    mesh = asked.decode(found, described)
    renderer = found.part("shap_e_renderer", torch.float32)
    # This call sets the weights of the renderer's network.
    renderer.decode_to_mesh(described, CPU, grid_size=8)
    painted = renderer.mlp(
        position=mesh.vertices[None], direction=None, ts=None, nerf_level="fine", rendering_mode="stf"
    ).channels[0]
    torch.testing.assert_close(mesh.rgb, painted, atol=1e-4, rtol=0)
    # Linear light is that of the decoder, unchanged.
    decoded = renderer.decode_to_mesh(described, CPU, grid_size=8).vertex_channels
    unchanged = torch.stack([decoded[channel] for channel in "RGB"], dim=1)
    assert torch.equal(shap_e(models[True], tone="linear").decode(found, described).rgb, unchanged)


def test_a_missing_surface_is_reported(models):
    with pytest.raises(UserError, match=r"found no surface.*Try: 'initializer\.prompt="):
        shap_e(models[False]).build("a corgi", seeded(), CPU)


def test_running_out_of_memory_is_reported(models, monkeypatch):
    def explode(*_, **__):
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(ShapE, "sample", explode)
    with pytest.raises(UserError, match=r"does not fit into the memory of cpu.*initializer\.dtype=float16"):
        shap_e(models[True]).build("a corgi", seeded(), CPU)


def test_the_model_is_freed_completely(models):
    from diffusers.pipelines.shap_e import ShapERenderer

    shap_e(models[True]).build("a corgi", seeded(), CPU)
    assert not [each for each in gc.get_objects() if type(each) is ShapERenderer]


# --- the fallback


def begin(seed: int = 0, **changes):
    return shap_e(**changes).begin("a corgi", seeded(seed), CPU)


def test_a_missing_model_is_an_error_or_the_fallback_with_a_note():
    with pytest.raises(UserError, match=r"initializer\.path: expected a folder with a model_index\.json"):
        begin()
    made = begin(fallback=BALL)
    assert made.note.startswith("Ball is used instead of Shap-E. initializer.path: expected a folder")


@pytest.mark.parametrize("seed", [1])
def test_the_fallback_gives_the_same_gaussians_as_without_shap_e(models, seed):
    wanted = BALL.build("a corgi", seeded(seed), CPU)
    # The second path draws random numbers before it finds no surface.
    for path in ("nowhere", models[False]):
        made = begin(path=path, fallback=BALL, seed=seed)
        assert torch.equal(made.gaussians.means, wanted.means)
        assert torch.equal(made.gaussians.sh, wanted.sh)


# --- keys


def test_the_size_has_one_setting():
    with pytest.raises(UserError, match=r"\.radius: expected null, since factor=2\.0 .* Try: .*=null$"):
        shap_e(factor=2.0)
