"""Laws of the training of our own priors: what is drawn, what is learned, and how a training continues."""

import json
import sys
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import pytest
import torch

pytest.importorskip("diffusers")
sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))

import train_prior
from prior_training import autoencoder, card, formats, loop, samples, stages, text, views, world

from cadam3d.core.cameras import orbit
from cadam3d.prior.mvdream import camera_numbers

SIZE = 16


def draw(seed=0):
    return world.Draw(torch.Generator().manual_seed(seed))


# --- captions and views


def test_no_caption_of_the_training_set_is_held_out():
    some = draw()
    held_out = {tuple(caption.split()[-2:]) for caption in world.held_out_captions()}
    assert ("red", "mushroom") in held_out
    for _ in range(2000):
        words = some.caption(some.form()).split()
        assert not held_out & set(pairwise(words))


def test_every_caption_is_a_prompt_of_the_embedded_world():
    from cadam3d.prior.shapes.grammar import parse

    some = draw(1)
    for caption in [*world.held_out_captions(), *(some.caption(some.form()) for _ in range(300))]:
        parse(caption)


def test_every_word_is_one_token(tmp_path):
    read = text.tokenizer(tmp_path)
    for word in text.words():
        assert len(read.tokenize(word)) == 1, word
    captions = "a red and blue striped cube next to a white mushroom, front right view from below"
    assert len(read(captions).input_ids) <= text.LENGTH
    assert len(read(", ".join(text.QUALITIES)).input_ids) <= text.LENGTH


@pytest.mark.slow
def test_views_depend_on_the_seed_and_the_number_of_the_file_alone(tmp_path):
    one, two = tmp_path / "one", tmp_path / "two"
    views.render_views(one, groups=3, size=SIZE, seed=0, processes=1)
    views.render_views(two, groups=3, size=SIZE, seed=0, processes=2)
    for load in (lambda folder: views.load_views(folder, [0]), views.load_held_out):
        first, second = load(one), load(two)
        assert torch.equal(first.rgba, second.rgba)
        assert first.captions == second.captions
    assert set(views.load_held_out(one).captions) <= set(world.held_out_captions())
    turns = (first.azimuth_deg - first.azimuth_deg[:, :1]) % 360
    torch.testing.assert_close(turns.sort(1).values, torch.tensor([[0.0, 90.0, 180.0, 270.0]]).expand(3, 4))


# --- what networks learn


def test_the_autoencoder_starts_as_a_smooth_enlargement_of_mean_colours():
    vae = autoencoder.build(4, 64)
    generator = torch.Generator().manual_seed(1)
    cells = 2 * torch.rand(4, 3, 2, 2, generator=generator) - 1
    smooth = torch.nn.functional.interpolate(cells, size=(64, 64), mode="bicubic").clamp(-1, 1)
    with torch.no_grad():
        latents = vae.encode(smooth).latent_dist.mode()
        decoded = vae.decode(latents).sample
    means = torch.nn.functional.avg_pool2d(smooth, 8)
    assert correlation(latents[:, :3], means) > 0.99
    # At the border, convolutions read zeros.
    inside = (..., slice(16, 48), slice(16, 48))
    assert correlation(decoded[inside], smooth[inside]) > 0.98


def correlation(a, b):
    return torch.corrcoef(torch.stack([a.flatten(), b.flatten()]))[0, 1]


@pytest.mark.parametrize("name", ["stable_diffusion", "mvdream", "stable_diffusion_3"])
def test_the_prior_completes_the_target_of_training_to_the_clean_latents(name):
    """A network without error gives the clean latents and the noise back, at the level that it was shown."""
    from cadam3d.prior.latent import completion, ddpm_path
    from cadam3d.prior.path import RectifiedFlow

    kind = formats.FORMATS[name](size=64)
    generator = torch.Generator().manual_seed(0)
    latents, noise = torch.randn(2, 8, kind.latent_channels, 4, 4, generator=generator)
    level = torch.rand(8, generator=generator)
    noised = kind.noised(latents, noise, level)
    if name == "stable_diffusion_3":
        path = RectifiedFlow(shift=kind.shift)
        prediction = path.from_velocity(noised.noisy, noised.target, level)
        torch.testing.assert_close(path.timestep(level), noised.timestep)
    else:
        path = ddpm_path(kind.scheduler)
        # The path is continuous: row i of the schedule is where its timestep is i.
        times = torch.linspace(0, 1, 200_001)
        rows = path.timestep(times)
        t = times[torch.searchsorted(rows, noised.timestep.float()).clamp_max(len(times) - 1)]
        prediction = completion(path, kind.scheduler)(noised.noisy, noised.target, t)
    torch.testing.assert_close(prediction.clean, latents, atol=2e-2, rtol=0)
    torch.testing.assert_close(prediction.noise, noise, atol=2e-2, rtol=0)


def test_cameras_are_described_as_the_prior_describes_them_through_any_lens():
    azimuth, elevation = torch.tensor([10.0, 100.0, -170.0, -80.0]), torch.full((4,), 20.0)
    other = orbit(azimuth, elevation, torch.full((4,), 2.2), torch.full((4,), 60.0), 32, 32)
    torch.testing.assert_close(formats.camera_rows(azimuth, elevation), camera_numbers(other))


def test_an_mvdream_that_starts_from_a_stable_diffusion_reads_no_camera_at_first():
    torch.manual_seed(0)
    single, several = (formats.FORMATS[name](size=SIZE) for name in ("stable_diffusion", "mvdream"))
    source, model = single.build(300), several.build(300)
    several.start(model, source.state_dict())
    latents = torch.randn(4, 4, 2, 2)
    noised = several.noised(latents, torch.randn_like(latents), torch.full((4,), 0.5))
    numbers = torch.full((4, text.LENGTH), 299)
    cameras = formats.camera_rows(torch.arange(4) * 90.0, torch.zeros(4))
    with torch.no_grad():
        same = several.predict(model, noised, numbers, cameras)
        torch.testing.assert_close(several.predict(model, noised, numbers, cameras.flip(0)), same)
        # Of four equal views, each attends to itself alone.
        equal = formats.Noised(noised.noisy[:1].expand(4, -1, -1, -1), noised.timestep, noised.target)
        alone = single.predict(source, equal, numbers, cameras)
    torch.testing.assert_close(several.predict(model, equal, numbers, cameras), alone)


# --- the loop


def fit(folder: Path, steps: int, stop_after: int | None = None) -> torch.Tensor:
    """Fit a line to noisy numbers for a number of steps, or stop early as if interrupted."""
    torch.manual_seed(0)
    model = torch.nn.Linear(1, 1)
    losses = []

    def loss(generator):
        if len(losses) == stop_after:
            raise KeyboardInterrupt
        x = torch.rand(16, 1, generator=generator)
        losses.append((model(x) - 3 * x - 1).square().mean())
        return losses[-1]

    stage = loop.Stage("line", model, loss, dict, 1e-2, loop.Budget(steps, None), seed=0)
    with suppress(KeyboardInterrupt):
        loop.run(stage, loop.Workers(0, 1, torch.device("cpu")), folder)
    return torch.cat([p.detach().flatten() for p in model.parameters()])


def test_a_training_that_was_interrupted_ends_as_if_it_had_not_been(tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "SAVE_EVERY", 0.0)
    folders = [tmp_path / name for name in ("whole", "parts")]
    for folder in folders:
        folder.mkdir()
    whole = fit(folders[0], 80)
    fit(folders[1], 80, stop_after=37)
    assert torch.equal(fit(folders[1], 80), whole)
    # A finished training is not continued, and logs nothing more.
    logged = (folders[1] / "curves.jsonl").read_text()
    assert torch.equal(fit(folders[1], 80, stop_after=0), whole)
    assert (folders[1] / "curves.jsonl").read_text() == logged


# --- the program


@pytest.mark.parametrize(("files", "processes"), [(1, 3), (2, 2), (5, 3), (5, 7)])
def test_every_file_is_read_and_no_process_is_without_one(files, processes, tmp_path):
    kind = formats.MVDreamFormat(size=SIZE)
    plan = stages.Plan(tmp_path, tmp_path, files * views.GROUPS, kind, 0, processes, "cpu", None)
    read = [list(plan.own_files(rank)) for rank in range(processes)]
    assert all(read)
    assert {number for numbers in read for number in numbers} == set(range(files))


@pytest.fixture(scope="module", autouse=True)
def small_networks_and_few_samples():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(formats.StableDiffusionFormat, "channels", (16, 32))
        patch.setattr(autoencoder, "CHANNELS", (16, 16, 16, 16))
        patch.setattr(samples, "STEPS", 2)
        patch.setattr(card, "SHOWN", card.SHOWN[:2])
        patch.setattr(card, "SHOWN_HELD_OUT", 2)
        yield


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A Stable Diffusion of a few steps, as the command writes it."""
    folder = tmp_path_factory.mktemp("model")
    line = f"--format stable_diffusion --out {folder} --groups 4 --size {SIZE} --processes 1"
    train_prior.main(f"{line} --autoencoder-steps 2 --steps 2".split())
    return folder


def refusal(line, capsys):
    with pytest.raises(SystemExit) as caught:
        train_prior.main(line.split())
    assert caught.value.code == 2
    return capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ("--groups 600", "--groups: expected a multiple of 512"),
        ("--size 20", "--size: expected a multiple of 16"),
        ("--start nowhere", "--start: expected a finished training"),
    ],
)
def test_wrong_options_are_refused_before_anything_is_written(options, reason, tmp_path, capsys):
    message = refusal(f"--format mvdream --out {tmp_path / 'new'} {options}", capsys)
    assert f"argument {reason}" in message
    assert not (tmp_path / "new").exists()


def test_files_of_another_format_are_not_mixed_with_a_new_training(tmp_path, capsys):
    (tmp_path / "model_index.json").write_text('{"_class_name": "StableDiffusion3Pipeline"}')
    assert "in the format stable_diffusion_3" in refusal(f"--format mvdream --out {tmp_path}", capsys)
    (tmp_path / "training" / "latents").mkdir(parents=True)
    for name in ("autoencoder.pt", "denoiser.safetensors", "views.json"):
        (tmp_path / "training" / name).touch()
    line = f"--format mvdream --out {tmp_path / 'new'} --start {tmp_path}"
    assert "stable_diffusion_3 cannot become a mvdream" in refusal(line, capsys)


@pytest.mark.slow
def test_the_command_writes_a_model_that_a_prior_reads(trained):
    index = json.loads((trained / "model_index.json").read_text())
    assert index["_class_name"] == "StableDiffusionPipeline"
    card = (trained / "README.md").read_text()
    assert "{" not in card
    assert (trained / "samples.png").is_file()
    words = json.loads((trained / "vocabulary.json").read_text())
    assert ["red", "mushroom"] in words["held_out"]
    plan = stages.Plan(trained, trained, 4, formats.StableDiffusionFormat(size=SIZE), 0, 1, "cpu", None)
    images = samples.draw(stages.prior_of(plan), "a red cube", samples.four_cameras(SIZE), 4, seed=0)
    assert images.shape == (4, SIZE, SIZE, 3)
    assert images.isfinite().all()


@pytest.mark.slow
def test_an_mvdream_continues_from_it(trained, tmp_path):
    line = f"--format mvdream --out {tmp_path / 'mv'} --start {trained} --processes 1 --steps 2"
    train_prior.main(line.split())
    index = json.loads((tmp_path / "mv" / "model_index.json").read_text())
    assert index["_class_name"] == "MVDreamPipeline"
    assert "from the weights" in (tmp_path / "mv" / "README.md").read_text()
