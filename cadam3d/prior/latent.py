"""LatentPrior: the base class of the pretrained latent models, which differ in text encoders and denoisers.

Text is embedded once per prompt and model and cached on disk. The text encoders are freed before the denoiser
is loaded. Networks compute in ``dtype``; all their outputs are converted to float32.
"""

import gc
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F  # noqa: N812  (the usual name)
from torch.utils.checkpoint import checkpoint

from cadam3d.core.cameras import Cameras
from cadam3d.core.checks import Count, one_of, require
from cadam3d.core.errors import UserError
from cadam3d.io.cache import default_cache_dir
from cadam3d.io.pretrained import DTYPES, VOCABULARY, ModelSource, Pretrained
from cadam3d.prior.base import Condition, DiffusionPrior, MemoryEstimate, PromptEmbedding
from cadam3d.prior.path import DDPM, Latents, NoisePath, PerView, Prediction, Rows
from cadam3d.prior.prompting import Mix, Prompting, guide
from cadam3d.prior.shapes.lexicon import Lexicon
from cadam3d.prior.texts import TextCache, Texts

# What to type for a model of each pipeline class.
PRIORS = {
    "StableDiffusionPipeline": "prior=stable_diffusion",
    "StableDiffusionXLPipeline": "prior=sdxl",
    "StableDiffusion3Pipeline": "prior=stable_diffusion_3",
    "MVDreamPipeline": "prior=mvdream",
}
# Every model of this family has this factor between an image and its latents.
FACTOR = 8  # pixels per side
MOST_STEPS = 100_000  # in the table of noise levels of a model
# The levels at which a network is used: only the ones in the table that it was trained on, or any.
LEVELS = ("table", "any")
# A network recognises nothing in images of more than this many times the size of those in its training.
LARGEST = 2
# In float16, the largest element of a view's gradient on its latents is brought between 2 ** (LIFT - 1) and
# 2 ** LIFT. That is in the middle between the numbers that are rounded to zero and those that overflow.
LIFT = 3
# The first compute capability of NVIDIA's GPUs with bfloat16.
BFLOAT16 = (8, 0)
# Numbers that the autoencoder keeps for a backward pass, per pixel and per channel of its first layer. All
# models of this family have the same layers.
KEPT = 24


@dataclass(frozen=True)
class TextCondition(Condition):
    """Weights over embedded texts for each view; the last text is empty."""

    texts: Texts
    mix: Mix  # over all of `texts`
    negative: Float[Tensor, "v k"]
    cameras: Cameras  # for models that read the cameras

    def unprompted(self) -> "TextCondition":
        """Return the same views with the empty text as both prompt and negative prompt."""
        empty = torch.zeros_like(self.negative)
        empty[:, -1] = 1
        mix = Mix(positive=empty, repelled=empty[:, None][:, :0], strengths=empty[:, :0])
        return TextCondition(texts=self.texts, mix=mix, negative=empty, cameras=self.cameras)


@dataclass(frozen=True)
class LatentEmbedding(PromptEmbedding):
    """The texts of a prompting, then the negative prompt, then the empty text."""

    texts: Texts
    prompting: Prompting

    def at(self, cameras: Cameras, background: Float[Tensor, "v 3"]) -> TextCondition:
        """Return the condition of these views; the background is not used."""
        cameras = cameras.to(self.texts.tokens.device)
        mix = self.prompting.mix(cameras)
        v = len(cameras)
        negative = mix.positive.new_zeros(v, mix.positive.shape[1] + 2)
        negative[:, -2] = 1
        padded = Mix(F.pad(mix.positive, (0, 2)), F.pad(mix.repelled, (0, 2)), mix.strengths)
        return TextCondition(texts=self.texts, mix=padded, negative=negative, cameras=cameras)


@dataclass(frozen=True, kw_only=True)
class LatentPrior(DiffusionPrior):
    """A pretrained model that denoises the latents of an autoencoder.

    Renders of any size are resized to ``size``. Latents are the mean of the autoencoder's posterior, where
    the released code draws from it. ``micro_batch`` limits the number of images in a network at a time: the
    autoencoder then runs again in the backward pass, part by part, so that memory does not grow with the
    number of views. The gradient does not change. With ``dtype`` "auto" the networks use ``half`` on CUDA and
    float32 elsewhere; :attr:`torch_dtype` has the exception.
    """

    path: str | Sequence[str] | None  # folder, or package: and a name; or a list of these
    ids: Sequence[str]  # on the hub
    revision: str | None  # on the hub
    variant: str | None  # of weight files
    prompting: Prompting
    size: Count | None  # pixels per side
    noise_levels: Annotated[str, one_of(LEVELS)]
    dtype: Annotated[str, one_of(("auto", *DTYPES))]
    vae_dtype: Annotated[str, one_of(("auto", "bfloat16", "float32"))]
    micro_batch: Count | None  # images
    compile: bool
    text_device: Annotated[str, one_of(("auto", "cpu"))]
    cache_dir: str | None  # folder

    kinds: ClassVar[tuple[str, ...]]  # pipeline classes that this prior can use
    encoders: ClassVar[tuple[str, ...]]  # parts that embed text
    network_part: ClassVar[str]  # the denoiser
    half: ClassVar[str]  # the 16-bit type that is safe for the model
    upcasts: ClassVar[bool]  # whether the autoencoder overflows in float16

    def __post_init__(self) -> None:
        super().__post_init__()
        unit = 2 * FACTOR
        self.expect((self.size or 0) % unit == 0, "size", f"a multiple of {unit}")

    # --- methods that a family of models implements ---------------------------------------------------------

    @abstractmethod
    def embed_texts(self, found: Pretrained, texts: Sequence[str], device: torch.device) -> Texts:
        """Load the text encoders, embed ``texts``, and free the encoders."""

    @abstractmethod
    def denoise(self, noisy: Latents, timestep: PerView, texts: Texts, cameras: Cameras) -> Latents:
        """Return the raw output of :attr:`network`, in its dtype."""

    @abstractmethod
    def complete(self, noisy: Latents, output: Latents, t: PerView) -> Prediction:
        """Convert the (guided) output of the network to a prediction in all three forms."""

    def tempered(self, noisy: Latents, guided: Prediction, output: Latents, t: PerView) -> Prediction:
        """Return ``guided``; a subclass may move it towards ``output``, the prediction without guidance."""
        return guided

    # --- the interface of a prior --------------------------------------------------------------------------

    def embed(self, prompt: str, negative: str) -> LatentEmbedding:
        """Embed the texts of the prompt, the negative prompt and the empty text, using the cache.

        Raises ``UserError`` for images too large for the network, and for words that it does not know.
        """
        self._require_readable(prompt, negative)
        texts = self._cache.embedded(self._listed(prompt, negative), self._embed)
        return LatentEmbedding(texts=texts.to(self.device), prompting=self.prompting)

    def encode(self, rgb: Float[Tensor, "v h w 3"]) -> Float[Tensor, "v c lh lw"]:
        """Convert images in [0, 1] to scaled latents; differentiable."""
        images = self._resized(rgb.permute(0, 3, 1, 2))
        if self.micro_batch is None:
            return self._to_latents(images)
        parts = [
            checkpoint(self._to_latents, part, use_reentrant=False, preserve_rng_state=False)
            for part in images.split(self.micro_batch)
        ]
        return torch.cat(parts)

    @torch.no_grad()
    def decode(
        self, latents: Float[Tensor, "v c lh lw"], height: int, width: int
    ) -> Float[Tensor, "v h w 3"]:
        """Convert scaled latents to images in [0, 1] of ``height`` x ``width`` pixels, without gradient."""
        config = self.vae.config
        raw = latents / config.scaling_factor + (config.shift_factor or 0)
        parts = [self.vae.decode(part.to(self.vae.dtype)).sample.float() for part in self._parts(raw)]
        images = F.interpolate(torch.cat(parts), size=(height, width), mode="bilinear", antialias=True)
        return (images.permute(0, 2, 3, 1) / 2 + 0.5).clamp(0, 1)

    @torch.no_grad()
    def predict(self, noisy: Latents, t: PerView, condition: TextCondition, scale: float) -> Prediction:
        """Predict under guidance, without gradient.

        All branches of guidance are in one batch, which ``micro_batch`` splits.
        """
        mix = condition.mix
        repelled = list(mix.repelled.unbind(dim=1))
        branches = [condition.negative, mix.positive, *repelled]
        if scale == 0:
            branches = [condition.negative]
        elif scale == 1 and not repelled:
            branches = [mix.positive]
        outputs = self._outputs(noisy.float(), t, condition, torch.cat(branches)).chunk(len(branches))
        guess = outputs[0]
        if len(branches) == 1:
            return self.complete(noisy, guess.to(noisy.dtype), t)
        guess = guide(outputs[0], outputs[1], outputs[2:], mix.strengths, scale)
        guided = self.complete(noisy, guess.to(noisy.dtype), t)
        return self.tempered(noisy, guided, outputs[1].to(noisy.dtype), t)

    def memory(self, prompt: str, negative: str, views: int, size: int | None) -> MemoryEstimate:
        """Estimate the memory of training from the configuration of the model alone.

        The working memory is what the autoencoder keeps for the backward pass; the denoiser has no gradient
        and needs less. On the CPU it may also be the denoiser's file, while that is converted. Renders have
        ``size`` pixels per side (512 if this is None) unless the prior resizes them. Raises ``UserError``
        in the cases in which :meth:`embed` does, since training calls this first.
        """
        self._require_readable(prompt, negative)
        pixels = self.size or size or 512
        vae = self.found.skeleton("vae", self._vae_dtype)
        network = self.found.skeleton(self.network_part, self.torch_dtype)
        numbers = min(views, self.micro_batch or views) * pixels**2 * vae.config.block_out_channels[0] * KEPT
        is_known = all(map(self._cache.has, self._listed(prompt, negative)))
        is_elsewhere = self.text_device == "cpu" and self.device.type != "cpu"
        encoders = [part for part in self.encoders if self.found.has(part)]
        if is_known or is_elsewhere:
            encoders = []
        texts = {part: self.found.skeleton(part, self.torch_dtype) for part in encoders}
        return MemoryEstimate(
            weights=_weights(vae) + _weights(network),
            working=max(numbers * self._vae_dtype.itemsize, self._converted(self.network_part, network)),
            texts=sum(map(_weights, texts.values()))
            + max(map(self._converted, texts, texts.values()), default=0),
        )

    def _converted(self, part: str, network: Any) -> int:
        """Return the bytes of a part's file if the CPU converts its numbers to the dtype of ``network``."""
        stored, needed = self.found.stored(part), _weights(network)
        # A file in the same dtype is mapped into memory, and the mapping is the network.
        is_converted = self.device.type == "cpu" and not 0.9 * needed < stored < 1.1 * needed
        return stored if is_converted else 0

    def lacks(self) -> str | None:
        """Return why the model cannot be used yet: libraries, ``path`` or weights; None if it is ready."""
        try:
            if self.path is not None:
                _ = self.found
            else:
                self.source.find(self.kinds, PRIORS, ask_hub=False)
        except UserError as error:
            if self.path is not None or "pip install" in str(error):
                return str(error)
            return f"no model on this disk; the first run would download one of {', '.join(self.ids)}"
        return None

    def load(self) -> None:
        """Load the autoencoder and the denoiser."""
        _ = self.vae, self.network

    def to(self, device: torch.device) -> "LatentPrior":
        """Move loaded networks to ``device``, load others there later, and return the prior."""
        self._place["device"] = device
        for part in ("vae", "network"):
            if part in self.__dict__:
                self.__dict__[part].to(device)
        return self

    # --- parts ---------------------------------------------------------------------------------------------

    @property
    def device(self) -> torch.device:
        """Return the device of the networks, loaded or not."""
        return self._place["device"]

    @property
    def torch_dtype(self) -> torch.dtype:
        """Return the dtype that the networks compute in. GPUs without bfloat16 compute in float16 instead."""
        if self.dtype != "auto":
            return DTYPES[self.dtype]
        if self.device.type != "cuda":
            return torch.float32
        # Torch emulates bfloat16 on older GPUs, which is slower than float32.
        has_bfloat16 = torch.cuda.get_device_capability(self.device) >= BFLOAT16
        return DTYPES[self.half] if has_bfloat16 else torch.float16

    @cached_property
    def source(self) -> ModelSource:
        """Return the folder or the hub names where the model is searched."""
        return ModelSource("prior", self.path, self.ids, self.revision, self.variant)

    @cached_property
    def found(self) -> Pretrained:
        """Return the model, found but not loaded. Raises ``UserError`` if there is none."""
        return self.source.find(self.kinds, PRIORS)

    @cached_property
    def lexicon(self) -> Lexicon | None:
        """Return the words that the model knows; None for models that read free text."""
        content = self.found.vocabulary()
        file = str(self.found.file.parent / VOCABULARY)
        return None if content is None else Lexicon.read(content, self.found.name, file)

    @cached_property
    def trained_size(self) -> int | None:
        """Return the pixels per side of the images in training; None if the model does not say it."""
        latents = self.found.config(self.network_part).get("sample_size")
        return latents * FACTOR if type(latents) is int else None

    @cached_property
    def scheduler(self) -> Mapping[str, Any]:
        """Return the configuration of the model's noise schedule."""
        return self.found.config("scheduler")

    def at_levels(self, path: NoisePath) -> NoisePath:
        """Return ``path`` at the rows of the model's table only, or unchanged if any level is used."""
        if self.noise_levels == "any":
            return path
        return Rows(path=path, rows=int(number_in(self.scheduler, "num_train_timesteps", 1, MOST_STEPS)))

    @cached_property
    def vae(self) -> Any:
        """Return the autoencoder, frozen and on the device."""
        vae = self._placed("vae", self._vae_dtype)
        number_in(vae.config, "scaling_factor", 1e-3, 1e3)
        if vae.config.shift_factor is not None:
            number_in(vae.config, "shift_factor", -1e3, 1e3)
        if self.compile:
            # Each is compiled at its first call. Most objectives never decode.
            vae.encoder.compile()
            vae.decoder.compile()
        return vae

    @cached_property
    def network(self) -> Any:
        """Return the denoiser, frozen and on the device."""
        network = self._placed(self.network_part, self.torch_dtype)
        return torch.compile(network) if self.compile else network

    def _placed(self, part: str, dtype: torch.dtype) -> Any:
        """Load a network to the device, with the layout in which its convolutions are fast there."""
        network = self.found.part(part, dtype).to(self.device)
        return network.to(memory_format=torch.channels_last) if self.device.type == "cuda" else network

    @cached_property
    def _place(self) -> dict[str, torch.device]:
        return {"device": torch.device("cpu")}

    @property
    def _vae_dtype(self) -> torch.dtype:
        if self.vae_dtype != "auto":
            return DTYPES[self.vae_dtype]
        overflows = self.upcasts and self.torch_dtype == torch.float16
        return torch.float32 if overflows else self.torch_dtype

    # --- work ----------------------------------------------------------------------------------------------

    def _require_readable(self, prompt: str, negative: str) -> None:
        """Raise ``UserError`` for images that are too large, and for words that the model does not know."""
        if self.size is not None:
            self._require_size("prior.size", self.size)
        for key, text in (("prompt", prompt), ("negative_prompt", negative)):
            if self.lexicon is not None:
                self.lexicon.require_known(key, text)

    def _require_size(self, key: str, size: int) -> None:
        """Raise ``UserError`` if images of ``size`` pixels per side are too large for the network."""
        trained = self.trained_size
        require(
            trained is None or size <= LARGEST * trained,
            key,
            expected=f"at most {LARGEST} times the {trained} pixels of the training",
            got=size,
            example=f"{key}={trained}",
        )

    def _resized(self, images: Float[Tensor, "v 3 h w"]) -> Float[Tensor, "v 3 s s2"]:
        size = (self.size, self.size) if self.size is not None else images.shape[2:]
        if self.size is None:
            self._require_size("camera.size", max(size))
        require(
            all(side % FACTOR == 0 for side in size),
            "camera.size",
            expected=f"a multiple of {FACTOR} pixels, since prior.size is null",
            got=size[0],
        )
        if tuple(images.shape[2:]) == tuple(size):
            return images
        return F.interpolate(images, size, mode="bilinear")

    def _to_latents(self, images: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b c lh lw"]:
        config, dtype = self.vae.config, self.vae.dtype
        images = 2 * images - 1
        mean = self.vae.encode(images.to(dtype)).latent_dist.mode().float()
        if dtype == torch.float16 and mean.requires_grad:
            lift_gradient(images, mean)
        return (mean - (config.shift_factor or 0)) * config.scaling_factor

    def _outputs(self, noisy: Latents, t: PerView, condition: TextCondition, weights: Tensor) -> Tensor:
        """Run the network on every row of ``weights``: all views, once for each branch of guidance."""
        copies = len(weights) // len(noisy)
        many = noisy.to(self.torch_dtype).repeat(copies, 1, 1, 1)
        timestep = self.noise_path.timestep(t.float()).repeat(copies)
        which = torch.arange(len(noisy), device=noisy.device).repeat(copies)
        outputs = []
        for rows in self._parts(torch.arange(len(many), device=noisy.device)):
            texts = condition.texts.mixed(weights[rows])
            cameras = condition.cameras.index(which[rows])
            outputs.append(self.denoise(many[rows], timestep[rows], texts, cameras).float())
        return torch.cat(outputs)

    def _parts(self, rows: Tensor) -> Sequence[Tensor]:
        return rows.split(self.micro_batch or len(rows))

    def _listed(self, prompt: str, negative: str) -> list[str]:
        return [*self.prompting.texts(prompt), negative, ""]

    def _embed(self, texts: Sequence[str]) -> Texts:
        device = torch.device("cpu") if self.text_device == "cpu" else self.device
        made = self.embed_texts(self.found, texts, device)
        gc.collect()
        if torch.cuda.is_available():
            torch.cuda.empty_cache()
        return made

    @property
    def _cache(self) -> TextCache:
        folder = Path(self.cache_dir).expanduser() if self.cache_dir else default_cache_dir()
        return TextCache(folder / "texts", self._identity)

    @property
    def _identity(self) -> tuple[str, ...]:
        """Return everything that an embedded text depends on, except the text."""
        return (type(self).__name__, self.found.identity, str(self.torch_dtype), *self.encoders)


def number_in(entries: Mapping[str, Any], name: str, low: float, high: float) -> float:
    """Return a number in the configuration of a model. Raises ``UserError`` unless it is in the range."""
    value: Any = entries.get(name)
    require(
        type(value) in (int, float) and low <= value <= high,
        "prior.path",
        expected=f"a model with a {name} from {low} to {high}",
        got=value,
        example="prior.path=DIR",
    )
    return value


def lift_gradient(inputs: Float[Tensor, "b ..."], outputs: Float[Tensor, "b ..."]) -> None:
    """Let a float32 gradient pass float16 between ``outputs`` and ``inputs`` without being rounded away.

    Many objectives divide by the number of elements, and float16 has no number between 0 and 6e-8. So the
    gradient of each view is multiplied by a power of two at the outputs, and divided by it at the inputs.
    Neither tensor may be a leaf or be used elsewhere.
    """
    scales: list[Tensor] = []

    def lift(grad: Tensor) -> Tensor:
        largest = grad.abs().amax(dim=tuple(range(1, grad.ndim)), keepdim=True)
        # The limits concern numbers that not even float32 has, and gradients without a single finite element.
        exponents = (LIFT - torch.frexp(largest).exponent).clamp(-100, 100)
        scales[:] = [torch.ldexp(torch.ones_like(largest), exponents)]
        return grad * scales[0]

    outputs.register_hook(lift)
    inputs.register_hook(lambda grad: grad / scales[0])


def ddpm_path(scheduler: Mapping[str, Any]) -> NoisePath:
    """Return the noise path of a scheduler's configuration. Raises ``UserError`` for unknown kinds."""
    kind = scheduler.get("beta_schedule")
    others = ("rescale_betas_zero_snr", "trained_betas")
    require(
        kind == "scaled_linear" and not any(scheduler.get(name) for name in others),
        "prior.path",
        expected=f"a model with a scaled_linear noise schedule, without {' or '.join(others)}",
        got=kind,
        example="prior.path=DIR",
    )
    return DDPM(
        train_steps=int(number_in(scheduler, "num_train_timesteps", 1, MOST_STEPS)),
        beta_start=number_in(scheduler, "beta_start", 0, 1),
        beta_end=number_in(scheduler, "beta_end", 0, 1),
    )


Complete = Callable[[Tensor, Tensor, Tensor], Prediction]


def completion(path: NoisePath, scheduler: Mapping[str, Any]) -> Complete:
    """Return the function that converts outputs to predictions. Raises ``UserError`` for unknown kinds."""
    kind = str(scheduler.get("prediction_type", "epsilon"))
    ways: dict[str, Complete] = {
        "epsilon": path.from_noise,
        "v_prediction": path.from_velocity,
        "sample": path.from_clean,
    }
    require(
        kind in ways,
        "prior.path",
        expected=f"a model with the prediction type {' or '.join(ways)}",
        got=kind,
        example="prior.path=DIR",
    )
    return ways[kind]


def _weights(network: Any) -> int:
    return sum(parameter.numel() * parameter.element_size() for parameter in network.parameters())
