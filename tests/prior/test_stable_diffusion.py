"""Stable Diffusion as a prior, compared with the parts of the pipeline, on tiny models from files."""

from types import SimpleNamespace

import pytest
import torch
from latents import KEYS, encodes_like_the_autoencoder, micro_batch_changes_nothing, normal

from cadam3d.core.cameras import orbit
from cadam3d.core.errors import UserError
from cadam3d.prior.latent import KEPT
from cadam3d.prior.prompting import Discrete, PerpNeg, Plain
from cadam3d.prior.stable_diffusion import StableDiffusion

diffusers = pytest.importorskip("diffusers")
huggingface_hub = pytest.importorskip("huggingface_hub")

PIXELS = 64
PERP_NEG = PerpNeg(curve="lucid", overhead_deg=None)


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def make(pipelines, cache):
    def make(prediction="epsilon", **changes):
        folder = str(pipelines("stable_diffusion", prediction=prediction))
        keys = KEYS | {"path": folder, "cache_dir": str(cache), "prompting": Plain(), "dtype": "auto"}
        return StableDiffusion(**keys | changes)

    return make


@pytest.fixture(scope="module")
def pipeline_of(pipelines):
    def load(prediction="epsilon"):
        pipeline = diffusers.StableDiffusionPipeline.from_pretrained(
            pipelines("stable_diffusion", prediction=prediction)
        )
        pipeline.scheduler.set_timesteps(1000)
        return pipeline

    return load


@pytest.fixture(scope="module")
def pipeline(pipeline_of):
    return pipeline_of()


def views(*azimuth):
    azimuth = torch.tensor(azimuth, dtype=torch.float32)
    ones = torch.ones_like(azimuth)
    return orbit(azimuth, 10 * ones, 3 * ones, 45 * ones, PIXELS, PIXELS)


def condition_of(prior, *azimuth, prompt="a corgi", negative="ugly"):
    cameras = views(*azimuth)
    return prior.embed(prompt, negative).at(cameras, torch.ones(len(cameras), 3))


LEVELS = torch.tensor([0.3, 0.8])


def test_the_network_is_used_at_the_levels_of_its_table_unless_any_is_asked_for(make):
    table, between = make("epsilon"), torch.tensor([0.3004, 0.7996])
    anywhere, noisy = make("epsilon", noise_levels="any"), normal(2, 4, 8, 8)
    at_rows, beside = (
        prior.predict(noisy, between, condition_of(prior, 0, 90), 7.5) for prior in (table, anywhere)
    )
    nearest = anywhere.predict(noisy, torch.tensor([0.3, 0.8]), condition_of(anywhere, 0, 90), 7.5)
    for form in ("clean", "noise", "velocity"):
        torch.testing.assert_close(getattr(at_rows, form), getattr(nearest, form))
        assert not torch.allclose(getattr(beside, form), getattr(nearest, form), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("prediction", ["epsilon", "v_prediction"])
def test_a_prediction_equals_that_of_the_pipeline(prediction, make, pipeline_of):
    """Compare with text encoder, UNet, guidance and scheduler of diffusers, at levels of its table."""
    pipeline = pipeline_of(prediction)
    prior, clean, noise = make(prediction), normal(2, 4, 8, 8), normal(2, 4, 8, 8, seed=1)
    # Rows of the table, where t = (row + 1) / 1000.
    steps = torch.tensor([299, 799])
    noisy = pipeline.scheduler.add_noise(clean, noise, steps)
    torch.testing.assert_close(prior.noise_path.mix(clean, noise, LEVELS), noisy, rtol=1e-5, atol=1e-5)
    positive, negative = pipeline.encode_prompt("a corgi", "cpu", 1, True, negative_prompt="ugly")
    with torch.no_grad():
        empty, full = (
            pipeline.unet(noisy, steps, encoder_hidden_states=text.repeat(2, 1, 1)).sample
            for text in (negative, positive)
        )
    output = empty + 7.5 * (full - empty)
    guess = prior.predict(noisy, LEVELS, condition_of(prior, 0, 90), 7.5)
    asked = guess.noise if prediction == "epsilon" else guess.velocity
    torch.testing.assert_close(asked, output, rtol=1e-4, atol=1e-4)
    for view, step in enumerate(steps):
        clean_guess = pipeline.scheduler.step(output[view], step, noisy[view]).pred_original_sample
        torch.testing.assert_close(guess.clean[view], clean_guess, rtol=1e-3, atol=1e-3)


def test_scale_zero_is_the_negative_prompt_alone_and_unprompted_uses_neither(make):
    prior, noisy = make(), normal(2, 4, 8, 8)
    condition = condition_of(prior, 0, 90)
    swapped = condition_of(prior, 0, 90, prompt="ugly", negative="a corgi")
    zero = prior.predict(noisy, LEVELS, condition, 0.0)
    torch.testing.assert_close(zero.noise, prior.predict(noisy, LEVELS, swapped, 1.0).noise)
    empty = condition_of(prior, 0, 90, prompt="", negative="")
    for scale in (1.0, 7.5):
        torch.testing.assert_close(
            prior.predict(noisy, LEVELS, condition.unprompted(), scale).noise,
            prior.predict(noisy, LEVELS, empty, 1.0).noise,
            rtol=1e-4,
            atol=1e-4,
        )


def test_latents_are_those_of_the_pipelines_autoencoder(make, pipeline):
    encodes_like_the_autoencoder(make(), pipeline.vae)


def test_micro_batches_do_not_change_results(make):
    prior = make(prompting=PERP_NEG)
    micro_batch_changes_nothing(prior, 2, condition_of(prior, 0, 100, -45), channels=4)


def test_renders_of_any_size_are_resized_and_gradients_reach_them(make):
    prior, rgb = make(), torch.rand(1, 50, 70, 3).requires_grad_()
    assert prior.encode(rgb).shape == (1, 4, 8, 8)
    prior.encode(rgb).sum().backward()
    assert rgb.grad.shape == rgb.shape
    with pytest.raises(UserError, match=r"camera\.size"):
        make(size=None).encode(rgb)
    assert make(size=None).encode(torch.rand(1, 32, 48, 3)).shape == (1, 4, 4, 6)


def test_decoding_gives_images_of_the_requested_size(make, pipeline):
    prior, latents = make(), normal(2, 4, 8, 8)
    images = prior.decode(latents, PIXELS, PIXELS)
    with torch.no_grad():
        raw = pipeline.vae.decode(latents / 0.18215).sample
    torch.testing.assert_close(images, (raw.permute(0, 2, 3, 1) / 2 + 0.5).clamp(0, 1), rtol=1e-4, atol=1e-4)
    assert prior.decode(latents, 48, 40).shape == (2, 48, 40, 3)


def test_each_view_gets_the_text_of_its_direction(make):
    prior = make(prompting=Discrete(front_deg=45, back_deg=45, overhead_deg=60))
    noisy, levels = normal(1, 4, 8, 8).repeat(3, 1, 1, 1), torch.full((3,), 0.5)
    front, back, again = prior.predict(noisy, levels, condition_of(prior, 0, 180, 10), 1.0).noise
    plain = make()
    worded = plain.predict(noisy[:1], levels[:1], condition_of(plain, 0, prompt="a corgi, back view"), 1.0)
    assert not torch.allclose(front, back, atol=1e-4)
    torch.testing.assert_close(front, again, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(back, worded.noise[0], rtol=1e-4, atol=1e-4)


# --- embedded texts on disk -------------------------------------------------------------------------------


@pytest.fixture
def counted(monkeypatch):
    """The texts that went through an encoder."""
    seen = []
    real = StableDiffusion.embed_texts

    def embed_texts(self, found, texts, device):
        seen.extend(texts)
        return real(self, found, texts, device)

    monkeypatch.setattr(StableDiffusion, "embed_texts", embed_texts)
    return seen


def test_a_text_is_embedded_once_per_model(make, counted, tmp_path):
    first = make(cache_dir=str(tmp_path)).embed("a corgi", "ugly").texts.tokens
    assert counted == ["a corgi", "ugly", ""]
    second = make(cache_dir=str(tmp_path)).embed("a corgi", "blurry").texts.tokens
    assert counted == ["a corgi", "ugly", "", "blurry"]
    torch.testing.assert_close(first[[0, 2]], second[[0, 2]], rtol=0, atol=0)
    make(cache_dir=str(tmp_path), dtype="bfloat16").embed("a corgi", "ugly")
    # Another dtype gives other numbers, so it has another entry.
    assert counted[4:] == ["a corgi", "ugly", ""]


def test_a_damaged_entry_is_replaced_and_an_unwritable_cache_is_no_error(make, counted, tmp_path):
    make(cache_dir=str(tmp_path)).embed("a corgi", "")
    for file in (tmp_path / "texts").iterdir():
        file.write_bytes(b"cut")
    make(cache_dir=str(tmp_path)).embed("a corgi", "")
    assert counted == ["a corgi", "", "a corgi", ""]
    (tmp_path / "file").write_text("x")
    make(cache_dir=str(tmp_path / "file")).embed("a corgi", "")
    assert len(counted) == 6


def test_the_text_encoder_is_freed_before_the_denoiser_is_loaded(make, tmp_path, monkeypatch):
    import weakref

    from cadam3d.io.pretrained import Pretrained

    kept, real = {}, Pretrained.part

    def part(self, name, dtype=None):
        loaded = real(self, name, dtype)
        if name == "unet":
            assert kept["text_encoder"]() is None
        elif name == "text_encoder":
            kept[name] = weakref.ref(loaded)
        return loaded

    monkeypatch.setattr(Pretrained, "part", part)
    prior = make(cache_dir=str(tmp_path))
    prior.embed("a corgi", "")
    prior.load()
    assert set(kept) == {"text_encoder"}


# --- memory -----------------------------------------------------------------------------------------------


def test_the_estimate_counts_weights_exactly_and_grows_with_the_batch(make, tmp_path):
    prior = make(cache_dir=str(tmp_path))
    estimate = prior.memory("a corgi", "", 2, None)
    assert "vae" not in prior.__dict__  # nothing was loaded
    assert "network" not in prior.__dict__
    networks = (prior.network, prior.vae)
    assert estimate.weights == sum(p.numel() * 4 for n in networks for p in n.parameters())
    four, parts = (make(**c).memory("a corgi", "", 4, None) for c in ({}, {"micro_batch": 2}))
    assert four.working == pytest.approx(2 * estimate.working, rel=0.02)
    assert parts.working == pytest.approx(estimate.working, rel=0.02)
    assert make(dtype="bfloat16").memory("a corgi", "", 2, None).working < 0.7 * estimate.working
    assert estimate.texts > 0
    prior.embed("a corgi", "")
    # The texts are cached, so no encoder will be loaded.
    assert prior.memory("a corgi", "", 2, None).texts == 0


def test_on_the_cpu_the_estimate_counts_files_that_are_converted(make, tmp_path):
    """While a file in float16 is converted to float32, both are in memory."""
    half, plain = tmp_path / "half", make()
    pipeline = diffusers.StableDiffusionPipeline.from_pretrained(plain.path).to(torch.float16)
    pipeline.save_pretrained(half)
    converted = make(path=str(half), size=16)
    file = half / "unet" / "diffusion_pytorch_model.safetensors"
    assert converted.memory("a corgi", "", 1, None).working == file.stat().st_size
    assert make(size=16).memory("a corgi", "", 1, None).working < file.stat().st_size
    texts = [prior.memory("a dog", "", 1, None).texts for prior in (plain, converted)]
    assert texts[1] == texts[0] + (half / "text_encoder" / "model.safetensors").stat().st_size


def test_the_estimate_of_the_autoencoder_is_what_autograd_keeps(make):
    """With the layers of the published models, and fewer channels."""
    config = {"block_out_channels": (32, 64, 128, 128), "layers_per_block": 2}
    vae = diffusers.AutoencoderKL.from_config(make().vae.config, **config).requires_grad_(False)
    kept = {}

    def pack(tensor):
        storage = tensor.untyped_storage()
        kept[storage.data_ptr()] = storage.nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        latents = vae.encode(normal(1, 3, PIXELS, PIXELS).requires_grad_()).latent_dist.mode()
    weights = {p.untyped_storage().data_ptr() for p in vae.parameters()}
    saved = sum(size for pointer, size in kept.items() if pointer not in weights)
    assert latents.requires_grad
    assert saved == pytest.approx(KEPT * 4 * 32 * PIXELS**2, rel=0.05)


def test_a_model_that_is_not_on_disk_is_lacking_and_the_hub_is_not_queried(make, monkeypatch):
    assert make().lacks() is None
    asked = []

    def download(name, file, *, revision, local_files_only):
        asked.append(local_files_only)
        raise huggingface_hub.errors.LocalEntryNotFoundError("no")

    monkeypatch.setattr(huggingface_hub, "hf_hub_download", download)
    assert "a/one, b/two" in make(path=None, ids=["a/one", "b/two"]).lacks()
    assert asked == [True, True]
    assert "expected a folder with a model_index.json" in make(path="/nowhere").lacks()


# --- layout and compilation ------------------------------------------------------------------------------


class Recording(torch.nn.Module):
    """A network that records how it is moved and compiled, and stays on the CPU."""

    def __init__(self, calls, config):
        super().__init__()
        self.calls, self.config = calls, config

    def to(self, *args, **options):
        self.calls += [*args, *options.values()]
        return self

    def compile(self):
        self.calls.append("compiled")


@pytest.mark.parametrize("device", [torch.device("cuda"), torch.device("cpu")])
def test_both_networks_have_the_layout_of_the_device_and_are_compiled(make, device, monkeypatch):
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (9, 0))
    monkeypatch.setattr(torch, "compile", lambda network: network.compile() or network)
    prior, calls = make(compile=True).to(device), {"vae": [], "unet": []}

    config = diffusers.configuration_utils.FrozenDict(scaling_factor=0.18, shift_factor=None)

    def part(name, dtype):
        network = Recording(calls[name], config)
        vars(network)["encoder"] = vars(network)["decoder"] = network
        return network

    vars(prior)["found"] = SimpleNamespace(part=part)
    prior.load()
    layout = [torch.channels_last] if device.type == "cuda" else []
    assert calls["vae"] == [device, *layout, "compiled", "compiled"]
    assert calls["unet"] == [device, *layout, "compiled"]


# --- impossible values ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"beta_schedule": "squaredcos_cap_v2"}, "scaled_linear"),
        ({"rescale_betas_zero_snr": True}, "rescale_betas_zero_snr"),
        ({"prediction_type": "flow"}, "epsilon"),
    ],
)
def test_an_unknown_noise_schedule_is_refused(make, changes, word):
    prior = make()
    object.__setattr__(prior, "scheduler", dict(prior.scheduler) | changes)
    with pytest.raises(UserError, match=word):
        prior.predict(normal(2, 4, 8, 8), LEVELS, condition_of(prior, 0, 0), 1.0)
