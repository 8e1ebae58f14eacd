"""ShapesPrior: an exact diffusion model of a procedural world, without weights and with a known truth."""

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras, fitting_distance, turntable
from cadam3d.core.checks import fail, require_choice, require_range, require_whole
from cadam3d.core.rendering import Truth
from cadam3d.prior.base import Condition, DiffusionPrior, PromptEmbedding
from cadam3d.prior.path import Latents, NoisePath, PerView, Prediction, per_view
from cadam3d.prior.shapes.grammar import EXAMPLE
from cadam3d.prior.shapes.mixture import Mixture
from cadam3d.prior.shapes.objects import known_objects, known_primitives
from cadam3d.prior.shapes.scene import Scene, build, signed_distance
from cadam3d.prior.shapes.tracer import Layers
from cadam3d.prior.shapes.tracing import TRACERS, find_tracer, stored_arrays, tracer_for

CENSUS_VIEWS = 4  # per object, equally spaced in azimuth
CENSUS_ELEVATION_DEG = 15.0
CENSUS_FOV_DEG = 45.0
# Cells per side of the grid on which the prediction error is drawn. It is smooth in any larger image.
ERROR_GRID = 8
# Radians per standard deviation of the projected noise. At this frequency the error fields of two
# independent noises are uncorrelated.
ERROR_FREQUENCY = 3.0


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
            variance=(4 * variance).clamp_min(floor),
        )


@dataclass(frozen=True)
class ShapesCondition(Condition):
    """The distributions of images of these views, under the prompt, the negative prompt and no prompt."""

    positive: Mixture
    negative: Mixture
    empty: Mixture

    def unprompted(self) -> "ShapesCondition":
        """Return the same views under the empty prompt, which allows every object of the world."""
        return replace(self, positive=self.empty, negative=self.empty)


@dataclass(frozen=True)
class ShapesEmbedding(PromptEmbedding):
    """The scenes of a prompt and of a negative prompt, which is None if it is empty."""

    prior: "ShapesPrior"
    positive: Scene
    negative: Scene | None
    census: Census

    def at(self, cameras: Cameras, background: Float[Tensor, "v 3"]) -> ShapesCondition:
        """Render the modes for these views."""
        empty = self.census.mixture(cameras, background, max(self.prior.spread, self.prior.edge_spread) ** 2)
        negative = empty if self.negative is None else self.prior.mixture(self.negative, cameras, background)
        return ShapesCondition(self.prior.mixture(self.positive, cameras, background), negative, empty)


@dataclass(frozen=True, kw_only=True)
class ShapesPrior(DiffusionPrior):
    """A Gaussian mixture over images of the scene, one mode per choice that the prompt leaves open.

    Model space is RGB in [-1, 1].
    """

    noise_path: NoisePath
    spread: float  # in model space
    edge_spread: float  # in model space
    model_error: float  # in model space
    samples_per_pixel: int  # along each axis
    census_size: int  # pixels per side
    seed: int
    tracer: str  # of TRACERS

    def __post_init__(self) -> None:
        require_range("prior.spread", self.spread, low=0, high=10)
        require_range("prior.edge_spread", self.edge_spread, low=0, high=10)
        require_range("prior.model_error", self.model_error, low=0, high=10)
        require_whole("prior.samples_per_pixel", self.samples_per_pixel, low=1, high=8)
        require_whole("prior.census_size", self.census_size, low=2, high=256)
        require_whole("prior.seed", self.seed, low=0, high=2**62)
        require_choice("prior.tracer", self.tracer, TRACERS)

    def embed(self, prompt: str, negative: str) -> ShapesEmbedding:
        """Parse both prompts; an empty negative prompt allows every object of the world.

        Raises ``UserError`` for an empty prompt, for words that the grammar does not know, and if a native
        tracer is wanted and cannot be compiled. It is compiled here, and not in the first step.
        """
        if not prompt.strip():
            raise fail("prompt", expected="an object", got=prompt, example=f'prompt="{EXAMPLE}"')
        positive = build(prompt)
        find_tracer(self.tracer)
        return ShapesEmbedding(
            prior=self,
            positive=positive,
            negative=build(negative, "negative_prompt") if negative.strip() else None,
            census=take_census(self.census_size, self.tracer),
        )

    def encode(self, rgb: Float[Tensor, "v h w 3"]) -> Float[Tensor, "v 3 h w"]:
        """Convert images in [0, 1] to [-1, 1]; the model denoises pixels."""
        return 2 * rgb.permute(0, 3, 1, 2) - 1

    @torch.no_grad()
    def decode(self, latents: Float[Tensor, "v 3 h w"], height: int, width: int) -> Float[Tensor, "v h w 3"]:
        """Convert [-1, 1] to images in [0, 1], clamped, without any change of size."""
        assert latents.shape[2:] == (height, width)
        return ((latents.permute(0, 2, 3, 1) + 1) / 2).clamp(0, 1)

    def mixture(self, scene: Scene, cameras: Cameras, background: Float[Tensor, "v 3"]) -> Mixture:
        """Return the distribution of images of a scene for each view."""
        layers, scene = _traced(scene, cameras, self.samples_per_pixel, self.tracer)
        edge = 4 * layers.alpha * (1 - layers.alpha)
        sigma = (self.spread + self.edge_spread * edge)[:, None].expand(-1, 3, -1, -1)
        return Mixture(
            means=2 * layers.images(scene.albedo, background) - 1,
            log_weights=scene.log_weights,
            variance=sigma * sigma,
        )

    @torch.no_grad()
    def predict(self, noisy: Latents, t: PerView, condition: ShapesCondition, scale: float) -> Prediction:
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
        """Return the images of all modes of ``prompt``, and their shape: they differ in colour only.

        The outlines are left out, because ``metric=outline`` is meant for priors that may be wrong about the
        object. ``truth=shapes`` has them.
        """
        return replace(true_scene(build(prompt), self.samples_per_pixel, tracer=self.tracer), alpha=None)

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


def true_scene(scene: Scene, samples_per_pixel: int, turns: int | None = None, tracer: str = "auto") -> Truth:
    """Return the images, the outlines and the shape of a scene, whose modes differ in colour only."""

    def images(cameras: Cameras, background: Tensor) -> Tensor:
        traced, sized = _traced(scene, cameras, samples_per_pixel, tracer)
        return traced.images(sized.albedo, background).permute(1, 0, 3, 4, 2)

    def alpha(cameras: Cameras) -> Tensor:
        traced, sized = _traced(scene, cameras, samples_per_pixel, tracer)
        return traced.alpha.expand(len(sized.albedo), *traced.alpha.shape)

    def distance(points: Tensor) -> Tensor:
        return signed_distance(scene.to(points.device, points.dtype), points)[None]

    return Truth(images=images, distance=distance, alpha=alpha, turns=turns)


def _traced(scene: Scene, cameras: Cameras, samples: int, tracer: str) -> tuple[Layers, Scene]:
    """Return the rendered scene, and the scene on the device and in the dtype of the cameras."""
    scene = scene.to(cameras.intrinsics.device, cameras.intrinsics.dtype)
    return tracer_for(tracer, cameras).trace(scene, cameras, samples), scene


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


@lru_cache(maxsize=4)
def take_census(size: int, tracer: str) -> Census:
    """Return the moments over all objects of the world, a few views of each and all modes, equally likely."""
    name = f"census-{size}-{find_tracer(tracer).identity}"
    return Census(**stored_arrays(name, lambda: {"maps": _measure(size, tracer)}))


def _measure(size: int, tracer: str) -> Float[Tensor, "11 s s"]:
    """Return the maps of the census, computed by tracing every object."""
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
    names = (*known_primitives(), *known_objects())
    for name in names:
        scene = build(name).to(torch.device("cpu"), torch.float32)
        layers = find_tracer(tracer).trace(scene, cameras, 1)
        images = layers.images(scene.albedo, black).double()
        alpha = layers.alpha.double()
        rgb_sum += images.mean(dim=(0, 1))
        rgb_square += images.square().mean(dim=(0, 1))
        cross += (images * alpha[:, None, None]).mean(dim=(0, 1))
        alpha_sum += alpha.mean(0)
        alpha_square += alpha.square().mean(0)
    count = len(names)
    rgb, alpha = rgb_sum / count, alpha_sum[None] / count
    rgb_variance, alpha_variance = rgb_square / count - rgb**2, alpha_square[None] / count - alpha**2
    return torch.cat([rgb, alpha, rgb_variance, alpha_variance, cross / count - rgb * alpha])
