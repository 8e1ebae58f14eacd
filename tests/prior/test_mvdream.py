"""Laws of MVDream as a prior: from a folder, from one published file, and across the views of a group."""

import json
import shutil
from dataclasses import replace

import pytest
import torch
from latents import KEYS, micro_batch_changes_nothing, normal
from ldm_names import single_file, unet_names
from safetensors.torch import save_file
from torch.nn.functional import normalize

from cadam3d.camera.multiview import Multiview
from cadam3d.core.cameras import orbit, turntable
from cadam3d.core.errors import UserError
from cadam3d.io.pretrained import empty
from cadam3d.prior import ldm
from cadam3d.prior.mvdream import MVDream
from cadam3d.prior.prompting import Plain

diffusers = pytest.importorskip("diffusers")
OWN = {"prompting": Plain(), "rescale": 0.0, "tokenizer": "owner/missing"}


@pytest.fixture(scope="module")
def folder(pipelines):
    return pipelines("mvdream")


@pytest.fixture(scope="module")
def pipe(folder):
    return diffusers.StableDiffusionPipeline.from_pretrained(folder, local_files_only=True)


@pytest.fixture(scope="module")
def prior(folder, tmp_path_factory):
    cache = str(tmp_path_factory.mktemp("cache"))
    return MVDream(path=str(folder), cache_dir=cache, **KEYS | OWN)


@pytest.fixture(scope="module")
def file(pipe, tmp_path_factory):
    """The path of a single file that holds the whole model, as published but with small networks."""
    file = tmp_path_factory.mktemp("published") / "sd-v2.1-base-4view.pt"
    torch.save(single_file(pipe.unet, pipe.vae, pipe.text_encoder), file)
    return file


@pytest.fixture(autouse=True)
def small(pipe, monkeypatch):
    """Let published files have the small networks of the pipeline."""
    parts = {"unet": pipe.unet, "vae": pipe.vae, "text_encoder": pipe.text_encoder}
    configurations = {
        name: dict(part.config.to_dict() if name == "text_encoder" else part.config)
        for name, part in parts.items()
    }
    monkeypatch.setattr(ldm, "CONFIGURATIONS", ldm.CONFIGURATIONS | configurations)


def views(count=4, size=64):
    groups = Multiview(
        size=size,
        elevation_deg=[0.0, 30.0],
        elevation_law="uniform",
        relative_distance=[0.8, 1.0],
        fov_y_deg=[15.0, 60.0],
    )
    return groups.sample(0, count, torch.Generator().manual_seed(3))


def condition_of(prior, cameras, prompt="a corgi", negative="ugly"):
    return prior.embed(prompt, negative).at(cameras, torch.zeros(len(cameras), 3))


def level_with(elevation=10.0, start=0.0, distance=3.0, fov=40.0):
    """Four views, a quarter turn apart."""
    ones = torch.ones(4)
    return orbit(90 * torch.arange(4) + start, ones * elevation, ones * distance, ones * fov, 64, 64)


def guess_of(prior, noisy, cameras, scale=7.5, t=0.4):
    return prior.predict(noisy, torch.full((len(noisy),), t), condition_of(prior, cameras), scale)


# --- predictions ------------------------------------------------------------------------------------------


class FromScratch:
    """Attention written out; self-attention spans four views."""

    def __call__(self, attention, states, encoder_hidden_states=None, **_):
        own = encoder_hidden_states is None
        queries = states.unflatten(0, (-1, 4)).flatten(1, 2) if own else states
        others = queries if own else encoder_hidden_states
        q, k, v = (
            layer(x).unflatten(2, (attention.heads, -1))
            for layer, x in ((attention.to_q, queries), (attention.to_k, others), (attention.to_v, others))
        )
        scores = torch.einsum("bqhc,bkhc->bhqk", q, k) / q.shape[-1] ** 0.5
        mixed = attention.to_out[0](torch.einsum("bhqk,bkhc->bqhc", scores.softmax(dim=-1), v).flatten(2))
        return mixed.unflatten(1, (4, -1)).flatten(0, 1) if own else mixed


@torch.no_grad()
def test_a_prediction_equals_the_parts_written_out(prior, pipe):
    """Build cameras as threestudio does, from right, up and backward of a camera that faces the origin."""
    cameras, clean, noise, k = views(8), normal(8, 4, 8, 8), normal(8, 4, 8, 8, seed=1), 400
    azimuth, elevation = (torch.deg2rad(a) for a in (cameras.azimuth_deg, cameras.elevation_deg))
    centre = torch.stack(
        [elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin()], dim=-1
    )
    right = normalize(torch.linalg.cross(-centre, torch.tensor([[0.0, 0.0, 1.0]]).expand(8, 3)), dim=-1)
    up = torch.linalg.cross(right, -centre)
    encoded = torch.eye(4).repeat(8, 1, 1)
    encoded[:, :3] = torch.stack([right, up, centre, centre], dim=-1)

    unet = type(pipe.unet).from_config(pipe.unet.config)
    unet.load_state_dict(pipe.unet.state_dict())
    unet.set_attn_processor(FromScratch())
    noisy = pipe.scheduler.add_noise(clean, noise, torch.full((8,), k - 1))
    positive, negative = pipe.encode_prompt("a corgi", "cpu", 1, True, negative_prompt="ugly")
    full, ugly = (
        unet(noisy, k - 1, encoder_hidden_states=text.repeat(8, 1, 1), class_labels=encoded.flatten(1)).sample
        for text in (positive, negative)
    )
    guess = guess_of(prior, noisy, cameras, t=k / 1000)
    torch.testing.assert_close(guess.noise, ugly + 7.5 * (full - ugly), rtol=1e-4, atol=1e-4)


def test_views_depend_on_their_own_group_and_on_no_other_group(prior):
    cameras, noisy = views(8), normal(8, 4, 8, 8)
    before = guess_of(prior, noisy, cameras).noise
    changed = noisy.clone()
    changed[1] += 1
    difference = (guess_of(prior, changed, cameras).noise - before).abs().flatten(1).amax(dim=1)
    assert (difference[:4] > 1e-4).all()
    assert (difference[4:] < 1e-5).all()


def test_the_camera_of_a_view_changes_its_prediction(prior):
    noisy = normal(4, 4, 8, 8)
    front, turned = level_with(), level_with(start=30.0)
    one, other = (guess_of(prior, noisy, cameras).noise for cameras in (front, turned))
    assert (one - other).abs().max() > 1e-3


def test_micro_batch_does_not_change_results(prior):
    micro_batch_changes_nothing(prior, size=4, condition=condition_of(prior, views(8)), channels=4)


def test_memory_is_estimated_for_whole_groups_only(prior):
    with pytest.raises(UserError, match=r"^views: expected a multiple of 4"):
        prior.memory("a corgi", "", 2, None)


# --- rescaling --------------------------------------------------------------------------------------------


def spreads(clean):
    return clean.unflatten(0, (-1, 4)).flatten(1).std(dim=1)


def test_rescaling_gives_a_group_the_spread_of_its_unguided_prediction(prior):
    cameras, noisy = views(8), normal(8, 4, 8, 8)
    noisy[4:] *= 0.5  # so that groups differ
    guided, unguided = (guess_of(prior, noisy, cameras, scale).clean for scale in (50.0, 1.0))
    assert not torch.allclose(spreads(guided), spreads(unguided), rtol=0.05)
    whole = guess_of(replace(prior, rescale=1.0), noisy, cameras, 50.0)
    torch.testing.assert_close(spreads(whole.clean), spreads(unguided), rtol=1e-4, atol=1e-4)
    half = guess_of(replace(prior, rescale=0.5), noisy, cameras, 50.0)
    torch.testing.assert_close(half.clean, (guided + whole.clean) / 2, rtol=1e-4, atol=1e-4)


def test_without_guidance_there_is_nothing_to_rescale(prior):
    noisy = normal(4, 4, 8, 8)
    for scale in (0.0, 1.0):
        one, other = (guess_of(replace(prior, rescale=r), noisy, views(), scale).clean for r in (0.0, 1.0))
        assert torch.equal(one, other)


# --- one file ---------------------------------------------------------------------------------------------


def is_the_same(one, other):
    cameras, noisy = views(), normal(4, 4, 8, 8)
    texts = [each.embed("a corgi", "ugly").texts.tokens for each in (one, other)]
    torch.testing.assert_close(*texts, rtol=1e-5, atol=1e-5)
    rgb = torch.rand(4, 64, 64, 3, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(one.encode(rgb), other.encode(rgb), rtol=1e-5, atol=1e-5)
    guesses = [guess_of(each, noisy, cameras).noise for each in (one, other)]
    torch.testing.assert_close(*guesses, rtol=1e-5, atol=1e-5)


def test_one_published_file_is_the_same_model(prior, folder, file, tmp_path):
    one = replace(prior, path=str(file), tokenizer=str(folder / "tokenizer"))
    is_the_same(one, prior)
    assert prior.noise_path == one.noise_path
    safe = tmp_path / "model.safetensors"
    save_file({k: v.contiguous().clone() for k, v in torch.load(file).items()}, safe)
    network = replace(one, path=str(safe), dtype="bfloat16").network
    for mine, half in zip(one.network.parameters(), network.parameters(), strict=True):
        assert torch.equal(mine.bfloat16(), half)


def test_the_tokenizer_of_one_file_pads_as_it_was_trained(prior, file, folder):
    """Padding is token 0, which is also the exclamation mark; the mark must not be lost in a prompt."""
    one = replace(prior, path=str(file), tokenizer=str(folder / "tokens"))
    tokenizer = one.found.part("tokenizer")
    numbers = tokenizer(["a!"], padding="max_length", max_length=77).input_ids[0]
    assert numbers[4:] == [0] * 73
    assert 0 not in numbers[:4]


@pytest.mark.parametrize("where", ["empty", "other"])
def test_a_tokenizer_that_does_not_fit_is_refused(prior, file, tmp_path, where):
    """If transformers finds no files, it silently builds a tokenizer without a vocabulary."""
    if where == "other":
        (tmp_path / "vocab.json").write_text(json.dumps({"a": 0, "<|startoftext|>": 1, "<|endoftext|>": 2}))
        (tmp_path / "merges.txt").write_text("#version: 0.2\n")
    with pytest.raises(UserError, match=r"^prior\.tokenizer: expected .* 519 pieces"):
        replace(prior, path=str(file), tokenizer=str(tmp_path)).embed("a corgi", "")


def test_a_folder_with_the_published_names_in_its_unet_is_the_same_model(prior, pipe, folder, tmp_path):
    """On the hub the UNet has a class of another package, of which no code is run."""
    model = tmp_path / "model"
    shutil.copytree(folder, model, ignore=shutil.ignore_patterns("unet", "tokens"))
    index = json.loads((model / "model_index.json").read_text())
    index |= {"_class_name": "MVDreamPipeline", "unet": ["mv_unet", "MultiViewUNetModel"]}
    (model / "model_index.json").write_text(json.dumps(index))
    there = replace(prior, path=str(model))
    (model / "unet").mkdir()
    with pytest.raises(UserError, match=r"has no unet/diffusion_pytorch_model\.safetensors"):
        there.embed("a corgi", "")
    torch.save(unet_names(pipe.unet), model / "unet" / "diffusion_pytorch_model.bin")
    is_the_same(replace(there), prior)


def test_a_model_without_cameras_is_refused(prior, pipelines):
    with pytest.raises(UserError, match=r"expected an MVDream model, .* Try: prior=stable_diffusion"):
        replace(prior, path=str(pipelines("stable_diffusion"))).embed("a corgi", "")


def test_the_published_configuration_has_the_sizes_of_the_model(monkeypatch):
    """The file has 1.4 million parameters more than Stable Diffusion 2.1, all of them for the cameras."""
    monkeypatch.undo()
    with torch.device("meta"):
        unet = empty(diffusers.UNet2DConditionModel, ldm.CONFIGURATIONS["unet"])
        vae = empty(diffusers.AutoencoderKL, ldm.CONFIGURATIONS["vae"])
    counts = [sum(p.numel() for p in network.parameters()) for network in (unet, vae)]
    cameras = 1280 * (16 + 1) + 1280 * (1280 + 1)
    assert counts == [865_910_724 + cameras, 83_653_863]


def test_a_damaged_or_unsupported_file_gives_a_message_of_one_line(prior, file, folder, tmp_path):
    broken = tmp_path / "broken.pt"
    broken.write_bytes(file.read_bytes()[:1000])
    tensors = torch.load(file)
    del tensors["model.diffusion_model.out.0.weight"]
    torch.save(tensors, tmp_path / "lacking.pt")
    torch.save({"other": torch.zeros(3)}, tmp_path / "other.pt")
    (tmp_path / "text.safetensors").write_text("hello")
    for name, words in (
        ("broken.pt", "is not a file of tensors"),
        ("text.safetensors", "is not a file of tensors"),
        ("other.pt", "contains no unet"),
        ("lacking.pt", "contains no unet"),
    ):
        there = replace(prior, path=str(tmp_path / name), tokenizer=str(folder / "tokenizer"))
        with pytest.raises(UserError, match=words) as raised:
            there.network  # noqa: B018
        assert "\n" not in str(raised.value)


def test_nothing_in_a_file_is_executed(prior, tmp_path):
    class Malicious:
        def __reduce__(self):
            return (exec, ("raise SystemExit('executed')",))

    torch.save({"weight": torch.zeros(1), "code": Malicious()}, tmp_path / "evil.pt")
    with pytest.raises(UserError, match="is not a file of tensors"):
        replace(prior, path=str(tmp_path / "evil.pt")).network  # noqa: B018


# --- requirements -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("count", "key"), [(3, "views"), (6, "views")])
def test_views_must_come_in_groups_of_four(prior, count, key):
    with pytest.raises(UserError, match=rf"^{key}: expected a multiple of 4.*Try: camera=multiview views=4"):
        condition_of(prior, turntable(count, elevation_deg=0.0, distance=3.0, fov_y_deg=40.0, size=64))


def test_views_of_a_group_must_be_a_quarter_turn_apart(prior):
    cameras = turntable(8, elevation_deg=0.0, distance=3.0, fov_y_deg=40.0, size=64)
    with pytest.raises(UserError, match=r"^camera: expected groups of four views.*azimuths"):
        condition_of(prior, cameras)
    regrouped = cameras.index(torch.tensor([6, 0, 2, 4, 7, 1, 3, 5]))
    assert len(condition_of(prior, regrouped).cameras) == 8


def test_views_of_a_group_must_have_one_elevation(prior):
    cameras = level_with(elevation=torch.tensor([0.0, 0.0, 0.0, 20.0]))
    with pytest.raises(UserError, match=r"^camera: expected groups of four views.*elevations"):
        condition_of(prior, cameras)


def test_a_group_must_have_one_noise_level(prior):
    t = torch.tensor([0.4, 0.4, 0.5, 0.4])
    with pytest.raises(UserError, match=r"^guidance\.shared_t: expected true"):
        prior.predict(normal(4, 4, 8, 8), t, condition_of(prior, views()), 7.5)
