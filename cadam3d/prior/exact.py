"""ExactPrior: a diffusion model in closed form of scenes whose images are known, and their census."""

import hashlib
import math
from abc import ABC, abstractmethod
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras, fitting_distance, turntable
from cadam3d.core.checks import whole, within
from cadam3d.core.errors import UserError
from cadam3d.core.rendering import Triangles, Truth
from cadam3d.io.atomic import replacing
from cadam3d.io.cache import default_cache_dir
from cadam3d.prior.base import Condition, DiffusionPrior, PromptEmbedding
from cadam3d.prior.mixture import Mixture
from cadam3d.prior.path import Latents, NoisePath, PerView, Prediction, per_view

CENSUS_VIEWS = 4  # per object, equally spaced in azimuth
CENSUS_ELEVATION_DEG = 15.0
CENSUS_FOV_DEG = 45.0
# Cells per side of the grid on which the prediction error is drawn. It is smooth in any larger image.
ERROR_GRID = 8
# Radians per standard deviation of the projected noise. At this frequency the error fields of two
# independent noises are uncorrelated.
ERROR_FREQUENCY = 3.0
PACKAGE = Path(__file__).parents[1]

Spread = Annotated[float, within(low=0, high=10)]
Samples = Annotated[int, whole(low=1, high=8)]  # points per pixel along each axis


class ExactScene(ABC):
    """The content of a prompt, with ``m`` modes; more than one if the prompt leaves something open."""

    log_weights: Float[Tensor, "m"]  # of the modes; the weights sum to one

    @abstractmethod
    def draw(
        self, cameras: Cameras, background: Float[Tensor, "v 3"], samples: int
    ) -> tuple[Float[Tensor, "v m 3 h w"], Float[Tensor, "v k h w"]]:
        """Return the image of each mode over the background and its alpha, both in [0, 1].

        ``k`` is ``m``, or 1 if all modes have the same alpha. There are ``samples`` x ``samples`` points in
        every pixel. The result is on the device and in the dtype of the cameras.
        """

    @abstractmethod
    def surfaces(self) -> list[Triangles]:
        """Return the surface of each mode, or a single one if all modes have the same."""

    @abstractmethod
    def census(self, size: int) -> "Census":
        """Return the census of the world that this scene is from, in pictures of ``size`` pixels per side."""

    def truth(self, samples: int, turns: int | None = None) -> Truth:
        """Return the images, the outlines and the surfaces, with ``samples`` points per pixel and axis."""

        def images(cameras: Cameras, background: Tensor) -> Tensor:
            return self.draw(cameras, background, samples)[0].permute(1, 0, 3, 4, 2)

        def alpha(cameras: Cameras) -> Tensor:
            black = cameras.intrinsics.new_zeros(len(cameras), 3)
            drawn = self.draw(cameras, black, samples)[1].transpose(0, 1)
            return drawn.expand(len(self.log_weights), *drawn.shape[1:])

        return Truth(images=images, surfaces=self.surfaces, alpha=alpha, turns=turns)


# Compared by identity, because the maps of every size are kept per census.
@dataclass(frozen=True, eq=False)
class Census:
    """Moments of premultiplied RGB and alpha over all images of the world, per pixel of a small picture."""

    # Means of RGB and alpha, their variances, and the covariances of each colour with alpha.
    maps: Float[Tensor, "11 s s"]

    def mixture(self, cameras: Cameras, background: Float[Tensor, "v 3"], floor: float) -> Mixture:
        """Return one Gaussian per pixel over the given backgrounds, in model space.

        Variances are at least ``floor``.
        """
        size = (cameras.height, cameras.width)
        sized = _enlarged(self, size, background.dtype, background.device)
        rgb, alpha, rgb_variance, alpha_variance, covariance = sized.split([3, 1, 3, 1, 3], dim=1)
        backdrop = background[:, :, None, None]
        mean = rgb + (1 - alpha) * backdrop
        variance = rgb_variance + backdrop**2 * alpha_variance - 2 * backdrop * covariance
        return Mixture(
            means=(2 * mean - 1)[:, None],
            log_weights=background.new_zeros(1),
            variance=(4 * variance).clamp_min(floor)[:, None],
        )


@dataclass(frozen=True)
class ExactCondition(Condition):
    """The distributions of images of these views, under the prompt, the negative prompt and no prompt."""

    positive: Mixture
    negative: Mixture
    empty: Mixture

    def unprompted(self) -> "ExactCondition":
        """Return the same views under the empty prompt, which allows every object of the world."""
        return replace(self, positive=self.empty, negative=self.empty)

    def nearest(self, rgb: Float[Tensor, "v h w 3"]) -> Float[Tensor, "v h w 3"]:
        """Return the images of the mode that is nearest to ``rgb`` over all views, in [0, 1]."""
        modes = (self.positive.means.permute(1, 0, 3, 4, 2) + 1) / 2
        return modes[(modes - rgb).square().mean(dim=(1, 2, 3, 4)).argmin()]


@dataclass(frozen=True)
class ExactEmbedding(PromptEmbedding):
    """The scenes of a prompt and of a negative prompt, which is None if it is empty."""

    prior: "ExactPrior"
    positive: ExactScene
    negative: ExactScene | None
    census: Census

    def at(self, cameras: Cameras, background: Float[Tensor, "v 3"]) -> ExactCondition:
        """Render the modes for these views."""
        empty = self.census.mixture(cameras, background, max(self.prior.spread, self.prior.edge_spread) ** 2)
        negative = empty if self.negative is None else self.prior.mixture(self.negative, cameras, background)
        return ExactCondition(self.prior.mixture(self.positive, cameras, background), negative, empty)


@dataclass(frozen=True, kw_only=True)
class ExactPrior(DiffusionPrior):
    """A Gaussian mixture over images of a scene, one mode per choice that the prompt leaves open.

    Model space is RGB in [-1, 1].
    """

    noise_path: NoisePath
    spread: Spread  # in model space
    edge_spread: Spread  # in model space
    model_error: Spread  # in model space
    samples_per_pixel: Samples
    census_size: Annotated[int, whole(low=2, high=256)]  # pixels per side
    seed: Annotated[int, whole(low=0, high=2**62)]

    @abstractmethod
    def scene(self, prompt: str, key: str = "prompt") -> ExactScene:
        """Return what the prompt in the setting ``key`` shows.

        Raises ``UserError`` for an empty prompt and for words that this world does not have.
        """

    def embed(self, prompt: str, negative: str) -> ExactEmbedding:
        """Read both prompts; an empty negative prompt allows every object of the world.

        Raises ``UserError`` for an empty prompt and for words that this world does not have.
        """
        positive = self.scene(prompt)
        return ExactEmbedding(
            prior=self,
            positive=positive,
            negative=self.scene(negative, "negative_prompt") if negative.strip() else None,
            census=positive.census(self.census_size),
        )

    def encode(self, rgb: Float[Tensor, "v h w 3"]) -> Float[Tensor, "v 3 h w"]:
        """Convert images in [0, 1] to [-1, 1]; the model denoises pixels."""
        return 2 * rgb.permute(0, 3, 1, 2) - 1

    @torch.no_grad()
    def decode(self, latents: Float[Tensor, "v 3 h w"], height: int, width: int) -> Float[Tensor, "v h w 3"]:
        """Convert [-1, 1] to images in [0, 1], clamped, without any change of size."""
        assert latents.shape[2:] == (height, width)
        return ((latents.permute(0, 2, 3, 1) + 1) / 2).clamp(0, 1)

    def mixture(self, scene: ExactScene, cameras: Cameras, background: Float[Tensor, "v 3"]) -> Mixture:
        """Return the distribution of images of a scene for each view."""
        images, alpha = scene.draw(cameras, background, self.samples_per_pixel)
        edge = 4 * alpha * (1 - alpha)
        sigma = (self.spread + self.edge_spread * edge)[:, :, None].expand(-1, -1, 3, -1, -1)
        return Mixture(means=2 * images - 1, log_weights=scene.log_weights.to(images), variance=sigma * sigma)

    @torch.no_grad()
    def predict(self, noisy: Latents, t: PerView, condition: ExactCondition, scale: float) -> Prediction:
        """Return the posterior means under guidance, plus the configured error.

        Branches of weight 0 are not computed. The clean image and the noise are both computed directly, so
        that nothing is divided by a small b.
        """
        clean, noise = torch.zeros_like(noisy), torch.zeros_like(noisy)
        for branch, (share, mixture) in enumerate(
            ((scale, condition.positive), (1 - scale, condition.negative))
        ):
            if share == 0:
                continue
            guess_clean, guess_noise = self._guess(noisy, t, mixture, branch)
            clean, noise = clean + share * guess_clean, noise + share * guess_noise
        return Prediction(clean=clean, noise=noise, velocity=self.noise_path.velocity(clean, noise, t))

    def truth(self, prompt: str) -> Truth:
        """Return the images of all modes of ``prompt``, and their surfaces.

        The outlines are left out, because ``metric=outline`` is meant for priors that may be wrong about the
        object. ``truth=shapes`` and ``truth=mesh`` have them.
        """
        return replace(self.scene(prompt).truth(self.samples_per_pixel), alpha=None)

    def _guess(self, noisy: Tensor, t: Tensor, mixture: Mixture, branch: int) -> tuple[Tensor, Tensor]:
        a, b = self.noise_path.a(t), self.noise_path.b(t)
        clean, noise = mixture.denoise(noisy, a, b)
        if self.model_error == 0:
            return clean, noise
        # Split so that a * clean + b * noise does not change. A clean image has no error, pure noise the full
        # error.
        norm = per_view((a * a + b * b).sqrt())
        error = self.model_error * error_field(noisy / norm, self.seed * 2 + branch)
        return clean + per_view(b) / norm * error, noise - per_view(a) / norm * error


def error_field(image: Latents, seed: int) -> Latents:
    """Return a smooth field of mean about zero and unit rms, a fixed and continuous function of ``image``.

    The image is multiplied with random signs and summed over each cell of a coarse grid, such that white
    noise keeps its variance. The sine of the sums is upsampled bicubically. Different noise gives a different
    field.
    """
    _, channels, height, width = image.shape
    signs, phase = _draws(channels, height, width, seed, image.dtype, image.device)
    like = (image.dtype, image.device)
    signed = torch.einsum("vchw,dchw->vdhw", image, signs) / math.sqrt(channels)
    projected = torch.einsum("gh,vdhw,kw->vdgk", _cells(height, *like), signed, _cells(width, *like))
    coarse = math.sqrt(2) * torch.sin(ERROR_FREQUENCY * projected + phase)
    return torch.einsum("hg,vdgk,wk->vdhw", _bicubic(height, *like), coarse, _bicubic(width, *like))


@lru_cache(maxsize=8)
def _draws(
    channels: int, height: int, width: int, seed: int, dtype: torch.dtype, device: torch.device
) -> tuple[Float[Tensor, "c c h w"], Float[Tensor, "c g g"]]:
    """Return random signs and phases that depend on ``seed`` alone."""
    generator = torch.Generator().manual_seed(seed)
    signs = torch.randint(0, 2, (channels, channels, height, width), generator=generator) * 2 - 1
    phase = 2 * math.pi * torch.rand(channels, ERROR_GRID, ERROR_GRID, generator=generator)
    return signs.to(device, dtype), phase.to(device, dtype)


@lru_cache(maxsize=8)
def _cells(size: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "g s"]:
    """Return the matrix of sums over the cells of the error grid; white noise keeps its variance."""
    cell = torch.arange(size, device=device) * ERROR_GRID // size
    member = (cell[None] == torch.arange(ERROR_GRID, device=device)[:, None]).to(dtype)
    return member / member.sum(1, keepdim=True).sqrt().clamp_min(1)


@lru_cache(maxsize=8)
def _bicubic(size: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "s g"]:
    """Return the interpolation matrix from the error grid to ``size`` pixels.

    It keeps the variance of independent cells.
    """
    grid = torch.eye(ERROR_GRID, device=device, dtype=dtype)[None, None]
    rows = torch.nn.functional.interpolate(grid, (size, ERROR_GRID), mode="bicubic", align_corners=False)
    return rows[0, 0] / rows[0, 0].norm(dim=1, keepdim=True)


@lru_cache(maxsize=8)
def _enlarged(
    census: Census, size: tuple[int, int], dtype: torch.dtype, device: torch.device
) -> Float[Tensor, "1 11 h w"]:
    """Return the maps of a census at the size of an image."""
    maps = census.maps[None].to(device, dtype)
    return torch.nn.functional.interpolate(maps, size, mode="bilinear", align_corners=False)


def take_census(scenes: Iterable[ExactScene], size: int) -> Float[Tensor, "11 s s"]:
    """Return the maps of a census: moments over a few views of each scene and its modes, equally likely."""
    cameras = turntable(
        CENSUS_VIEWS,
        elevation_deg=CENSUS_ELEVATION_DEG,
        distance=fitting_distance(CENSUS_FOV_DEG),
        fov_y_deg=CENSUS_FOV_DEG,
        size=size,
    )
    black = torch.zeros(CENSUS_VIEWS, 3)
    rgb_sum, rgb_square, cross = torch.zeros(3, 3, size, size, dtype=torch.float64)
    alpha_sum, alpha_square = torch.zeros(2, size, size, dtype=torch.float64)
    count = 0
    for scene in scenes:
        images, alpha = (drawn.double() for drawn in scene.draw(cameras, black, 1))
        rgb_sum += images.mean(dim=(0, 1))
        rgb_square += images.square().mean(dim=(0, 1))
        cross += (images * alpha[:, :, None]).mean(dim=(0, 1))
        alpha_sum += alpha.mean(dim=(0, 1))
        alpha_square += alpha.square().mean(dim=(0, 1))
        count += 1
    rgb, alpha = rgb_sum / count, alpha_sum[None] / count
    rgb_variance, alpha_variance = rgb_square / count - rgb**2, alpha_square[None] / count - alpha**2
    return torch.cat([rgb, alpha, rgb_variance, alpha_variance, cross / count - rgb * alpha])


def stored_census(identity: str, scenes: Iterable[ExactScene], size: int) -> Census:
    """Return the census of ``scenes``, from the user's cache folder if it is there.

    ``identity`` says which scenes these are. A file belongs to one state of the sources, one version of
    torch, one instruction set and one number of threads, because all of these may change the last bits.
    """
    facts = (torch.__version__, torch.backends.cpu.get_cpu_capability(), torch.get_num_threads())
    digest = hashlib.sha256(_code() + repr((identity, size, *facts)).encode()).hexdigest()
    path = default_cache_dir() / "census" / f"{digest[:32]}.pt"
    try:
        return Census(torch.load(path, weights_only=True))
    # The file is missing, or it is damaged, which makes its reader raise almost anything.
    except Exception:
        maps = take_census(scenes, size)
    # A cache that cannot be written only costs time.
    with suppress(UserError, OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            torch.save(maps, temporary)
    return Census(maps)


@cache
def _code() -> bytes:
    places = ("core/**/*.py", "prior/**/*.py", "io/mesh_file.py")
    paths = sorted(path for place in places for path in PACKAGE.glob(place))
    return hashlib.sha256(b"".join(path.read_bytes() for path in paths)).digest()
