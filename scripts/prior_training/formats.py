"""The three formats: the networks of each, what they learn to predict, and the folder that holds them."""

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch
from prior_training.text import LENGTH, MULTIVIEW, SINGLE, Wording
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  (the usual name)

from cadam3d.core.cameras import orbit
from cadam3d.io.pretrained import INDEX
from cadam3d.prior.mvdream import CAMERA, VIEWS, across_views, camera_numbers
from cadam3d.prior.stable_diffusion_3 import counting_zeros

WIDTH = 64  # of the text encoder
TRAIN_STEPS = 1000
BETAS = {"beta_start": 0.00085, "beta_end": 0.012, "beta_schedule": "scaled_linear"}


@dataclass(frozen=True)
class Noised:
    """What the networks of one format read and should answer."""

    noisy: Tensor  # "b c h w"
    timestep: Tensor  # "b", from 0 to 1000
    target: Tensor  # "b c h w"


@dataclass(frozen=True)
class Format(ABC):
    """A family of diffusion models."""

    size: int  # of images, in pixels per side

    name: ClassVar[str]  # of the prior that reads it
    latent_channels: ClassVar[int]
    prompting: ClassVar[str] = "compass"
    wording: ClassVar[Wording] = SINGLE
    group: ClassVar[int] = 1  # views that are denoised together
    rate: ClassVar[float] = 1.5e-3  # the peak of the learning rate
    network: ClassVar[str] = "unet"  # the part that denoises

    @property
    @abstractmethod
    def target(self) -> str:
        """Return what the network predicts."""

    @abstractmethod
    def build(self, tokens: int) -> nn.ModuleDict:
        """Return the networks for a vocabulary of this many tokens, with random weights."""

    @abstractmethod
    def noised(self, latents: Tensor, noise: Tensor, level: Tensor) -> Noised:
        """Return noisy latents for levels in [0, 1), and the prediction that the network should make."""

    @abstractmethod
    def predict(self, model: nn.ModuleDict, noised: Noised, numbers: Tensor, cameras: Tensor) -> Tensor:
        """Return the prediction of the network for the tokens and the camera numbers of every view."""

    @abstractmethod
    def save(self, folder: Path, model: nn.ModuleDict, vae: Any, tokenizer: Any) -> None:
        """Write a folder in the layout of diffusers, in half precision."""

    def start(self, model: nn.ModuleDict, weights: Mapping[str, Tensor]) -> None:
        """Begin with the weights of a model that was trained already."""
        model.load_state_dict(weights)

    def scaling(self, latents: Tensor) -> tuple[float, float]:
        """Return the shift and the factor of latents, ``shift_factor`` and ``scaling_factor`` in diffusers.

        The network sees (latents - shift) * factor, of which the standard deviation is 1.
        """
        return 0.0, 1 / float(latents.std())


def _text_encoder(tokens: int, width: int, projected: bool = False) -> nn.Module:
    """Return a small CLIP text encoder; the last two tokens are those of start and end."""
    from transformers import CLIPTextConfig, CLIPTextModel, CLIPTextModelWithProjection

    config = CLIPTextConfig(
        vocab_size=tokens,
        hidden_size=width,
        intermediate_size=4 * width,
        num_hidden_layers=2,
        num_attention_heads=4,
        max_position_embeddings=LENGTH,
        projection_dim=width,
        bos_token_id=tokens - 2,
        eos_token_id=tokens - 1,
        pad_token_id=tokens - 1,
    )
    return CLIPTextModelWithProjection(config) if projected else CLIPTextModel(config)


@dataclass(frozen=True)
class StableDiffusionFormat(Format):
    """A UNet over four latent channels on the DDPM schedule, with one CLIP text encoder."""

    name: ClassVar[str] = "stable_diffusion"
    channels: ClassVar[tuple[int, ...]] = (64, 128)  # of the blocks of the UNet
    latent_channels: ClassVar[int] = 4

    @property
    def target(self) -> str:
        """Return the prediction type of the scheduler."""
        return "v_prediction"

    def build(self, tokens: int) -> nn.ModuleDict:
        """Return a UNet and a text encoder."""
        from diffusers import UNet2DConditionModel

        unet = UNet2DConditionModel(
            sample_size=self.size // 8,
            block_out_channels=self.channels,
            layers_per_block=1,
            norm_num_groups=16,
            down_block_types=("CrossAttnDownBlock2D",) * len(self.channels),
            up_block_types=("CrossAttnUpBlock2D",) * len(self.channels),
            cross_attention_dim=WIDTH,
            attention_head_dim=4,
            use_linear_projection=True,
            **self._cameras,
        )
        return nn.ModuleDict({"text_encoder": _text_encoder(tokens, WIDTH), "unet": unet})

    @property
    def _cameras(self) -> dict[str, Any]:
        return {}

    @property
    def scheduler(self) -> dict[str, Any]:
        """Return the configuration of the noise schedule."""
        return {**BETAS, "num_train_timesteps": TRAIN_STEPS, "prediction_type": self.target}

    def noised(self, latents: Tensor, noise: Tensor, level: Tensor) -> Noised:
        """Add noise at whole timesteps of the DDPM schedule (Ho et al. 2020)."""
        betas = torch.linspace(BETAS["beta_start"] ** 0.5, BETAS["beta_end"] ** 0.5, TRAIN_STEPS) ** 2
        kept = torch.cumprod(1 - betas, 0).to(latents)
        timestep = (level * TRAIN_STEPS).long()
        a, b = (x[timestep][:, None, None, None] for x in (kept.sqrt(), (1 - kept).sqrt()))
        return Noised(a * latents + b * noise, timestep, a * noise - b * latents)

    def predict(self, model: nn.ModuleDict, noised: Noised, numbers: Tensor, cameras: Tensor) -> Tensor:
        """Run the UNet with text cross-attention."""
        states = model["text_encoder"](numbers)[0]
        return model["unet"](noised.noisy, noised.timestep, encoder_hidden_states=states).sample

    def save(self, folder: Path, model: nn.ModuleDict, vae: Any, tokenizer: Any) -> None:
        """Write a StableDiffusionPipeline."""
        from diffusers import DDIMScheduler, StableDiffusionPipeline

        scheduler = DDIMScheduler(**self.scheduler, clip_sample=False, set_alpha_to_one=False, steps_offset=1)
        StableDiffusionPipeline(
            vae=vae,
            text_encoder=model["text_encoder"],
            tokenizer=tokenizer,
            unet=model["unet"],
            scheduler=scheduler,
            safety_checker=None,
            feature_extractor=None,
            requires_safety_checker=False,
        ).to(torch.float16).save_pretrained(folder)


@dataclass(frozen=True)
class MVDreamFormat(StableDiffusionFormat):
    """A UNet that denoises four views together, a quarter turn apart, and reads their cameras."""

    name: ClassVar[str] = "mvdream"
    prompting: ClassVar[str] = "plain"
    wording: ClassVar[Wording] = MULTIVIEW
    group: ClassVar[int] = VIEWS
    rate: ClassVar[float] = 1e-3

    @property
    def _cameras(self) -> dict[str, Any]:
        return {"class_embed_type": "projection", "projection_class_embeddings_input_dim": CAMERA}

    def build(self, tokens: int) -> nn.ModuleDict:
        """Return a UNet with attention across the views of a group, and a text encoder.

        At the start, cameras have no effect, so that the weights of a Stable Diffusion can be continued.
        """
        model = super().build(tokens)
        across_views(model["unet"])
        last = model["unet"].class_embedding.linear_2
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        return model

    def start(self, model: nn.ModuleDict, weights: Mapping[str, Tensor]) -> None:
        """Begin with a trained MVDream, or with a trained Stable Diffusion, which has no camera layers."""
        missing, unexpected = model.load_state_dict(weights, strict=False)
        assert not unexpected
        assert all("class_embedding" in name for name in missing)

    def predict(self, model: nn.ModuleDict, noised: Noised, numbers: Tensor, cameras: Tensor) -> Tensor:
        """Run the UNet; the cameras are added to the time input."""
        states = model["text_encoder"](numbers)[0]
        return model["unet"](
            noised.noisy, noised.timestep, encoder_hidden_states=states, class_labels=cameras
        ).sample

    def save(self, folder: Path, model: nn.ModuleDict, vae: Any, tokenizer: Any) -> None:
        """Write a folder whose index names an MVDreamPipeline."""
        super().save(folder, model, vae, tokenizer)
        index = json.loads((folder / INDEX).read_text(encoding="utf-8"))
        index["_class_name"] = "MVDreamPipeline"
        (folder / INDEX).write_text(json.dumps(index, indent=2) + "\n", encoding="utf-8")


@dataclass(frozen=True)
class StableDiffusion3Format(Format):
    """A transformer over image and text tokens on the straight path, with two CLIP text encoders."""

    name: ClassVar[str] = "stable_diffusion_3"
    latent_channels: ClassVar[int] = 16
    network: ClassVar[str] = "transformer"
    shift: ClassVar[float] = 3.0
    rate: ClassVar[float] = 1e-3
    # Of the transformer: its width, and the width of the first and the second text encoder.
    widths: ClassVar[tuple[int, int, int]] = (160, 64, 64)

    @property
    def target(self) -> str:
        """Return the velocity of the straight path."""
        return "noise minus clean latents"

    def build(self, tokens: int) -> nn.ModuleDict:
        """Return a transformer of four blocks and two text encoders with projections."""
        from diffusers import SD3Transformer2DModel

        width, first, second = self.widths
        transformer = SD3Transformer2DModel(
            sample_size=self.size // 8,
            patch_size=2,
            in_channels=self.latent_channels,
            out_channels=self.latent_channels,
            num_layers=4,
            attention_head_dim=32,
            num_attention_heads=width // 32,
            joint_attention_dim=first + second,
            caption_projection_dim=width,
            pooled_projection_dim=first + second,
            pos_embed_max_size=self.size // 8,
        )
        return nn.ModuleDict(
            {
                "text_encoder": _text_encoder(tokens, first, projected=True),
                "text_encoder_2": _text_encoder(tokens, second, projected=True),
                "transformer": counting_zeros(transformer),
            }
        )

    def scaling(self, latents: Tensor) -> tuple[float, float]:
        """Return the mean of the latents as the shift, and the factor, since this format has a shift."""
        return float(latents.mean()), 1 / float(latents.std())

    def noised(self, latents: Tensor, noise: Tensor, level: Tensor) -> Noised:
        """Mix latents and noise on the straight path, with the shift of the model (Esser et al. 2024)."""
        sigma = self.shift * level / (1 + (self.shift - 1) * level)
        weight = sigma[:, None, None, None]
        return Noised((1 - weight) * latents + weight * noise, TRAIN_STEPS * sigma, noise - latents)

    def predict(self, model: nn.ModuleDict, noised: Noised, numbers: Tensor, cameras: Tensor) -> Tensor:
        """Run the transformer on the penultimate states of both encoders and a zero in place of T5's."""
        read = [
            model[name](numbers, output_hidden_states=True) for name in ("text_encoder", "text_encoder_2")
        ]
        states = torch.cat([each.hidden_states[-2] for each in read], dim=-1)
        return model["transformer"](
            hidden_states=noised.noisy,
            timestep=noised.timestep,
            encoder_hidden_states=F.pad(states, (0, 0, 0, 1)),
            pooled_projections=torch.cat([each.text_embeds for each in read], dim=-1),
        ).sample

    def save(self, folder: Path, model: nn.ModuleDict, vae: Any, tokenizer: Any) -> None:
        """Write a StableDiffusion3Pipeline without T5."""
        from diffusers import FlowMatchEulerDiscreteScheduler, StableDiffusion3Pipeline

        StableDiffusion3Pipeline(
            vae=vae,
            text_encoder=model["text_encoder"],
            text_encoder_2=model["text_encoder_2"],
            text_encoder_3=None,
            tokenizer=tokenizer,
            tokenizer_2=tokenizer,
            tokenizer_3=None,
            transformer=model["transformer"],
            scheduler=FlowMatchEulerDiscreteScheduler(num_train_timesteps=TRAIN_STEPS, shift=self.shift),
        ).to(torch.float16).save_pretrained(folder)


FORMATS: dict[str, type[Format]] = {
    kind.name: kind for kind in (StableDiffusionFormat, MVDreamFormat, StableDiffusion3Format)
}


def camera_rows(azimuth_deg: Tensor, elevation_deg: Tensor) -> Tensor:
    """Return the numbers by which prior=mvdream describes cameras, "v 16"; they do not depend on the lens."""
    one = torch.ones_like(azimuth_deg)
    return camera_numbers(orbit(azimuth_deg, elevation_deg, 3 * one, 45 * one, 8, 8))
