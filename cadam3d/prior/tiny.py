"""prior=tiny: a small random network with the interface of a real prior, for tests and dry runs."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  (the usual name)

from cadam3d.core.cameras import Cameras
from cadam3d.core.checks import one_of, whole
from cadam3d.core.device import upload
from cadam3d.prior.base import Condition, DiffusionPrior, PromptEmbedding
from cadam3d.prior.path import Latents, NoisePath, PerView, Prediction

# The special tokens; 0 to 255 are the bytes of the prompt.
START, PADDING = 256, 257
MAX_TOKENS = 96  # longer prompts are cut
GROUPS = 8  # of every normalization
FREQUENCIES = 32  # of the time embedding


@dataclass(frozen=True)
class TinyCondition(Condition):
    """Two prompts as tokens, and the directions of the views."""

    positive: Int[Tensor, "tokens"]
    negative: Int[Tensor, "tokens"]
    directions: Float[Tensor, "v 4"]  # cosine and sine of azimuth and of elevation

    def unprompted(self) -> "TinyCondition":
        """Return the same views under two empty prompts."""
        empty = tokenize("").to(self.positive.device)
        return TinyCondition(positive=empty, negative=empty, directions=self.directions)


@dataclass(frozen=True)
class TinyEmbedding(PromptEmbedding):
    """Two prompts as tokens; the network embeds them itself."""

    positive: Int[Tensor, "tokens"]
    negative: Int[Tensor, "tokens"]

    def at(self, cameras: Cameras, background: Float[Tensor, "v 3"]) -> TinyCondition:
        """Return the condition of these views; the background is not used."""
        angles = torch.deg2rad(torch.stack([cameras.azimuth_deg, cameras.elevation_deg], dim=-1))
        directions = torch.cat([angles.cos(), angles.sin()], dim=-1)
        return TinyCondition(positive=self.positive, negative=self.negative, directions=directions)


@dataclass(frozen=True, kw_only=True)
class Tiny(DiffusionPrior):
    """A random UNet that is conditioned on text and view, for tests and dry runs of the rest of the program.

    Its weights depend on ``seed`` and ``width`` alone; creating them does not change the global random state.
    Images of 8 x 8 pixels or more, with even or odd sides, are averaged down to three channels in [-1, 1].
    """

    predicts: Annotated[str, one_of(("noise", "velocity"))]
    noise_path: NoisePath
    width: Annotated[int, one_of(range(16, 49, GROUPS))]  # channels
    downscale: Annotated[int, one_of(range(1, 9))]  # pixels per side
    seed: Annotated[int, whole(low=0, high=2**62)]

    @cached_property
    def network(self) -> "TinyUNet":
        """Return the frozen network, which is created on first use."""
        with torch.random.fork_rng(devices=[]):
            # torch.manual_seed would also reseed all GPUs.
            torch.default_generator.manual_seed(self.seed)
            network = TinyUNet(self.width)
        return network.requires_grad_(False).eval()

    def embed(self, prompt: str, negative: str) -> TinyEmbedding:
        """Embed any two texts; each is cut after 95 bytes."""
        return TinyEmbedding(positive=tokenize(prompt), negative=tokenize(negative))

    def encode(self, rgb: Float[Tensor, "v h w 3"]) -> Float[Tensor, "v c lh lw"]:
        """Convert images in [0, 1] to three channels in [-1, 1], smaller by ``downscale``, rounded up."""
        pixels = rgb.permute(0, 3, 1, 2)
        return 2 * F.avg_pool2d(pixels, self.downscale, ceil_mode=True) - 1

    @torch.no_grad()
    def decode(
        self, latents: Float[Tensor, "v c lh lw"], height: int, width: int
    ) -> Float[Tensor, "v h w 3"]:
        """Convert three channels in [-1, 1] to images in [0, 1], clamped.

        Every latent fills the pixels that it is the average of.
        """
        rows = latents.repeat_interleave(self.downscale, dim=2)[:, :, :height]
        pixels = rows.repeat_interleave(self.downscale, dim=3)[..., :width]
        return ((pixels.permute(0, 2, 3, 1) + 1) / 2).clamp(0, 1)

    @torch.no_grad()
    def predict(self, noisy: Latents, t: PerView, condition: TinyCondition, scale: float) -> Prediction:
        """Predict negative + scale * (positive - negative), without gradient, both halves in one batch."""
        prompts = [condition.positive] if scale == 1 else [condition.negative, condition.positive]
        copies = len(prompts)
        output = self.network(
            noisy.float().repeat(copies, 1, 1, 1),
            self.noise_path.timestep(t).float().repeat(copies),
            upload(torch.stack(prompts), noisy.device).repeat_interleave(noisy.shape[0], dim=0),
            condition.directions.to(noisy.device, torch.float32).repeat(copies, 1),
        )
        halves = output.to(noisy.dtype).chunk(copies)
        guess = torch.lerp(halves[0], halves[-1], scale)
        complete = self.noise_path.from_noise if self.predicts == "noise" else self.noise_path.from_velocity
        return complete(noisy, guess, t)

    def notice(self) -> str:
        """Return the warning that this prior cannot generate objects."""
        return (
            "prior=tiny is a random network for tests and dry runs: it cannot generate a meaningful object. "
            "Use prior=shapes instead."
        )

    def to(self, device: torch.device) -> "Tiny":
        """Move the network to ``device``, in place, and return the prior."""
        self.network.to(device)
        return self


class TinyUNet(nn.Module):
    """A UNet with three scales, two skips and one cross-attention to the prompt at the coarsest scale.

    It has fewer than 2 million parameters.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        wide = 2 * width
        self.token = nn.Embedding(PADDING + 1, wide)
        self.position = nn.Embedding(MAX_TOKENS, wide)
        self.time = nn.Linear(2 * FREQUENCIES, wide)
        self.view = nn.Linear(4, wide)
        self.mixture = nn.Sequential(nn.SiLU(), nn.Linear(wide, wide), nn.SiLU())

        self.enter = nn.Conv2d(3, width, 3, padding=1)
        self.fine_down = ResidualBlock(width, width, wide)
        self.shrink1 = nn.Conv2d(width, wide, 3, stride=2, padding=1)
        self.middle_down = ResidualBlock(wide, wide, wide)
        self.shrink2 = nn.Conv2d(wide, wide, 3, stride=2, padding=1)
        self.coarse1 = ResidualBlock(wide, wide, wide)
        self.attention = PromptAttention(wide)
        self.coarse2 = ResidualBlock(wide, wide, wide)
        self.middle_up = ResidualBlock(2 * wide, wide, wide)
        self.fine_up = ResidualBlock(wide + width, width, wide)
        self.leave = nn.Sequential(nn.GroupNorm(GROUPS, width), nn.SiLU(), nn.Conv2d(width, 3, 3, padding=1))

    def forward(
        self,
        noisy: Float[Tensor, "b 3 h w"],
        timestep: Float[Tensor, "b"],
        tokens: Int[Tensor, "b tokens"],
        directions: Float[Tensor, "b 4"],
    ) -> Float[Tensor, "b 3 h w"]:
        """Return the raw prediction; the prior decides whether it is the noise or the velocity."""
        is_padding = tokens == PADDING
        text = self.token(tokens) + self.position.weight
        context = self.mixture(self.time(sinusoids(timestep)) + self.view(directions))

        fine = self.fine_down(self.enter(noisy), context)
        middle = self.middle_down(self.shrink1(fine), context)
        coarse = self.coarse1(self.shrink2(middle), context)
        coarse = self.coarse2(self.attention(coarse, text, is_padding), context)
        middle = self.middle_up(_join(coarse, middle), context)
        fine = self.fine_up(_join(middle, fine), context)
        return self.leave(fine)


class ResidualBlock(nn.Module):
    """Two convolutions, with a scale and a shift from the context between them (FiLM)."""

    def __init__(self, channels_in: int, channels: int, context: int) -> None:
        super().__init__()
        self.before = nn.Sequential(
            nn.GroupNorm(GROUPS, channels_in), nn.SiLU(), nn.Conv2d(channels_in, channels, 3, padding=1)
        )
        self.film = nn.Linear(context, 2 * channels)
        self.norm = nn.GroupNorm(GROUPS, channels)
        self.after = nn.Sequential(nn.SiLU(), nn.Conv2d(channels, channels, 3, padding=1))
        self.skip = nn.Conv2d(channels_in, channels, 1)

    def forward(self, x: Float[Tensor, "b i h w"], context: Float[Tensor, "b k"]) -> Float[Tensor, "b o h w"]:
        """Return the input plus the output of the block."""
        factor, offset = self.film(context)[..., None, None].chunk(2, dim=1)
        changed = self.after(self.norm(self.before(x)) * (1 + factor) + offset)
        return self.skip(x) + changed


class PromptAttention(nn.Module):
    """Cross-attention from every pixel to the tokens of the prompt."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(GROUPS, channels)
        self.query = nn.Linear(channels, channels)
        self.key = nn.Linear(channels, channels)
        self.value = nn.Linear(channels, channels)

    def forward(
        self, x: Float[Tensor, "b c h w"], text: Float[Tensor, "b t c"], is_padding: Tensor
    ) -> Float[Tensor, "b c h w"]:
        """Return the input plus the attended tokens; padding is masked."""
        pixels = self.norm(x).flatten(2).transpose(1, 2)
        answers = F.scaled_dot_product_attention(
            self.query(pixels), self.key(text), self.value(text), attn_mask=~is_padding[:, None, :]
        )
        return x + answers.transpose(1, 2).unflatten(2, x.shape[2:])


def tokenize(text: str) -> Int[Tensor, "tokens"]:
    """Return a start token and the UTF-8 bytes of ``text``, cut or padded to ``MAX_TOKENS``."""
    tokens = [START, *text.encode("utf-8")][:MAX_TOKENS]
    return torch.tensor(tokens + [PADDING] * (MAX_TOKENS - len(tokens)))


def sinusoids(timestep: Float[Tensor, "b"]) -> Float[Tensor, "b k"]:
    """Return cosines and sines of ``timestep`` at geometrically spaced frequencies from 1 to 1e-4."""
    exponents = torch.arange(FREQUENCIES, device=timestep.device) / (FREQUENCIES - 1)
    phases = timestep[:, None] * torch.exp(-math.log(10_000) * exponents)
    return torch.cat([phases.cos(), phases.sin()], dim=-1)


def _join(coarse: Float[Tensor, "b i h w"], skip: Float[Tensor, "b o lh lw"]) -> Tensor:
    """Enlarge ``coarse`` to the size of ``skip``, odd or even, and concatenate both."""
    return torch.cat([F.interpolate(coarse, size=skip.shape[2:], mode="nearest"), skip], dim=1)
