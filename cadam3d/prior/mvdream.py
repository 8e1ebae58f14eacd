"""MVDream: denoises four views together in a UNet that reads their cameras and attends across them."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.core.checks import Share, require
from cadam3d.core.errors import UserError
from cadam3d.io.pretrained import Pretrained
from cadam3d.prior.base import MemoryEstimate
from cadam3d.prior.latent import PRIORS, LatentEmbedding, TextCondition
from cadam3d.prior.ldm import SingleFile, with_ldm_unet
from cadam3d.prior.path import Latents, PerView, Prediction, per_view
from cadam3d.prior.stable_diffusion import StableDiffusion
from cadam3d.prior.texts import Texts

VIEWS = 4  # per group
# To read a noise level waits for a GPU, so only the first predictions of a run are checked there. These are
# more than one step's, because an inversion may begin at one level for all views.
CHECKED = 100
# The network reads a camera as a matrix of four by four numbers.
CAMERA = 16
# Largest deviation from a quarter turn between the views of a group, and of their elevations.
TOLERANCE_DEG = 1.0


@dataclass(frozen=True)
class MultiviewEmbedding(LatentEmbedding):
    """Embedded texts for views that come in groups of four."""

    def at(self, cameras: Cameras, background: Float[Tensor, "v 3"]) -> TextCondition:
        """Return the condition of these views. Raises ``UserError`` unless they form groups of four."""
        require_groups(cameras.on_cpu())
        return super().at(cameras, background)


@dataclass(frozen=True, kw_only=True)
class MVDream(StableDiffusion):
    """Shi et al. 2024, on Stable Diffusion 2.1: views that agree, since they are denoised together.

    Consecutive views form a group of four, a quarter turn apart, at one elevation and one ``t``, as drawn by
    ``camera=multiview``.
    """

    rescale: Share
    tokenizer: str  # a folder or a name on the hub

    kinds: ClassVar = ("MVDreamPipeline", "StableDiffusionPipeline")

    def __post_init__(self) -> None:
        super().__post_init__()
        expected = f"null or a multiple of {VIEWS}, since {VIEWS} views are denoised together"
        self.expect((self.micro_batch or 0) % VIEWS == 0, "micro_batch", expected, VIEWS)

    @cached_property
    def found(self) -> Pretrained:
        """Return the model in a folder, in one file or on the hub.

        Raises ``UserError`` if its network does not read cameras.
        """
        if isinstance(self.path, str) and Path(self.path).expanduser().is_file():
            found = SingleFile.open(self.source, self.tokenizer)
        else:
            found = with_ldm_unet(self.source.find(self.kinds, PRIORS))
        if found.config("unet").get("projection_class_embeddings_input_dim") != CAMERA:
            raise UserError(
                f"prior.path: expected an MVDream model, got {found.where!r}, which has no camera input "
                "in its UNet. Try: prior=stable_diffusion"
            )
        return found

    @cached_property
    def network(self) -> Any:
        """Return the denoiser, frozen and on the device, with attention across the views of a group."""
        return across_views(super().network)

    def embed(self, prompt: str, negative: str) -> MultiviewEmbedding:
        """Embed the texts of the prompt, the negative prompt and the empty text."""
        embedding = super().embed(prompt, negative)
        return MultiviewEmbedding(texts=embedding.texts, prompting=embedding.prompting)

    def denoise(self, noisy: Latents, timestep: PerView, texts: Texts, cameras: Cameras) -> Latents:
        """Run the UNet with text cross-attention; the cameras are added to the time input."""
        matrices = camera_numbers(cameras).to(noisy)
        return self.network(noisy, timestep, encoder_hidden_states=texts.tokens, class_labels=matrices).sample

    def load(self) -> None:
        """Load the autoencoder and the denoiser; the noise levels of a new run are checked again."""
        super().load()
        vars(self)["checked"] = 0

    @torch.no_grad()
    def predict(self, noisy: Latents, t: PerView, condition: TextCondition, scale: float) -> Prediction:
        """Predict every view, without gradient. Raises ``UserError`` if ``t`` differs within a group."""
        checked = vars(self).get("checked", 0)
        if t.device.type == "cpu" or checked < CHECKED:
            vars(self)["checked"] = checked + 1
            levels = t.view(-1, VIEWS)
            require(
                bool((levels == levels[:, :1]).all()),
                "guidance.shared_t",
                expected="true, since prior=mvdream denoises four views together at one noise level",
                got=False,
                example="guidance.shared_t=true",
            )
        return super().predict(noisy, t, condition, scale)

    def tempered(self, noisy: Latents, guided: Prediction, output: Latents, t: PerView) -> Prediction:
        """Rescale the clean prediction towards its spread without guidance (MVDream, sec. 3.2)."""
        if self.rescale == 0:
            return guided
        alone = self.complete(noisy, output, t).clean
        ratio = _spread(alone) / _spread(guided.clean)
        factor = torch.lerp(torch.ones_like(ratio), ratio, self.rescale)
        return self.noise_path.from_clean(noisy, guided.clean * per_view(factor), t)

    def memory(self, prompt: str, negative: str, views: int, size: int | None) -> MemoryEstimate:
        """Estimate the memory of training. Raises ``UserError`` unless ``views`` is a multiple of four."""
        require_whole_groups(views)
        return super().memory(prompt, negative, views, size)


def camera_numbers(cameras: Cameras) -> Float[Tensor, "v 16"]:
    """Return camera-to-world matrices, flattened row by row, as the network reads them.

    World axes are the same as ours: +z up and the front at +x, as in the published code. Camera axes are
    OpenGL's: +x right, +y up, +z backward. Camera centres are moved to the unit sphere.
    """
    to_world = cameras.world_to_camera[:, :3, :3].transpose(1, 2)
    axes = torch.cat([to_world[:, :, :1], -to_world[:, :, 1:]], dim=2)
    centres = torch.nn.functional.normalize(cameras.positions, dim=-1)
    views = len(cameras)
    last = torch.cat([to_world.new_zeros(views, 1, 3), to_world.new_ones(views, 1, 1)], dim=2)
    return torch.cat([torch.cat([axes, centres[..., None]], dim=2), last], dim=1).flatten(1)


def require_whole_groups(views: int) -> None:
    """Raise ``UserError`` unless ``views`` is a multiple of four."""
    require(
        views % VIEWS == 0,
        "views",
        expected=f"a multiple of {VIEWS}, since prior=mvdream denoises {VIEWS} views together",
        got=views,
        example=f"camera=multiview views={VIEWS}",
    )


def require_groups(cameras: Cameras) -> None:
    """Raise ``UserError`` unless consecutive views form groups of four at one elevation.

    The views of a group must be a quarter turn apart, within ``TOLERANCE_DEG``.
    """
    require_whole_groups(len(cameras))
    azimuth, elevation = (a.view(-1, VIEWS) for a in (cameras.azimuth_deg, cameras.elevation_deg))
    turns = (azimuth - azimuth[:, :1]) % 360
    quarters = 90.0 * torch.arange(VIEWS, device=turns.device)
    off = torch.maximum((turns.sort(dim=1).values - quarters).abs(), (elevation - elevation[:, :1]).abs())
    require(
        bool((off < TOLERANCE_DEG).all()),
        "camera",
        expected="groups of four views, a quarter turn apart at one elevation, for prior=mvdream",
        got=f"azimuths {azimuth[0].tolist()} and elevations {elevation[0].tolist()} degrees",
        example="camera=multiview",
    )


class AcrossViews:
    """An attention processor that treats the pixels of a group of views as the pixels of one image."""

    def __init__(self, processor: Any) -> None:
        self.processor = processor

    def __call__(self, attention: Any, states: Float[Tensor, "b n c"], *args: Any, **kwargs: Any) -> Tensor:
        """Return the output of the layer for every view."""
        b, n, c = states.shape
        together = states.reshape(b // VIEWS, VIEWS * n, c)
        return self.processor(attention, together, *args, **kwargs).reshape(b, n, c)


def across_views(network: Any) -> Any:
    """Make the self-attention of ``network`` span the views of a group; changes and returns ``network``."""
    processors = {
        name: AcrossViews(each) if name.endswith("attn1.processor") else each
        for name, each in network.attn_processors.items()
    }
    network.set_attn_processor(processors)
    return network


def _spread(clean: Latents) -> PerView:
    """Return the standard deviation over a whole group, repeated for each of its views."""
    groups = clean.reshape(len(clean) // VIEWS, -1)
    return groups.std(dim=1).clamp_min(1e-8).repeat_interleave(VIEWS)
