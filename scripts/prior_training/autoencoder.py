"""The autoencoder: eight pixels per latent along each side, as in Stable Diffusion, and small.

With a random start, such a small network hardly learns colours in an hour of CPU time. It therefore starts
as a function that is useful already: latents are the mean colours of cells of 8 x 8 pixels, and decoding
enlarges them smoothly. Each colour channel is carried as a pair with opposite signs. Such a pair passes
through the activations unchanged, because silu(x) - silu(-x) = x. All residual branches start at 0.
"""

from dataclasses import dataclass

import torch
from diffusers import AutoencoderKL
from prior_training.views import Groups, backgrounds
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  (the usual name)

CHANNELS = (16, 32, 64, 64)
FACTOR = 8  # pixels per latent, along each side
# Two channels hold constants of this size with opposite signs, so that the normalisation of groups of
# channels depends little on the image.
LEVEL = 3.0
CARRIED = 8  # channels: red, green and blue, their negatives, and the two constants
# The logarithm of the variance of latents at the start.
LOG_VARIANCE = -6.0
KL_WEIGHT = 1e-6
# An object is as important as its background, although it covers less of the image.
OBJECT_WEIGHT = 2.0
GROUPS = 2  # of four images, per step and process


def build(latent_channels: int, size: int) -> AutoencoderKL:
    """Return an autoencoder for images of ``size`` pixels that averages and enlarges them."""
    vae = AutoencoderKL(
        block_out_channels=CHANNELS,
        down_block_types=("DownEncoderBlock2D",) * len(CHANNELS),
        up_block_types=("UpDecoderBlock2D",) * len(CHANNELS),
        latent_channels=latent_channels,
        layers_per_block=1,
        norm_num_groups=2,
        sample_size=size,
        # SD 3 has no such layers.
        use_quant_conv=latent_channels == 4,
        use_post_quant_conv=latent_channels == 4,
    )
    with torch.no_grad():
        for module in vae.modules():
            _start(module)
        _enter(vae.encoder.conv_in)
        _enter(vae.decoder.conv_in)
        for convolution in (vae.encoder.conv_out, vae.decoder.conv_out):
            _leave(convolution)
        for convolution in (vae.quant_conv, vae.post_quant_conv):
            if convolution is not None:
                convolution.weight.zero_()
                convolution.bias.zero_()
                convolution.weight[:, :, 0, 0].fill_diagonal_(1)
        variances = slice(latent_channels, None)
        vae.encoder.conv_out.weight[variances] *= 0.1
        vae.encoder.conv_out.bias[variances] = LOG_VARIANCE
        _calibrate(vae, size)
    return vae


def _start(module: nn.Module) -> None:
    """Make a residual block the identity, and let resampling average or enlarge the carried channels."""
    kind = type(module).__name__
    if kind == "ResnetBlock2D":
        module.conv2.weight.zero_()
        module.conv2.bias.zero_()
        if module.conv_shortcut is not None:
            _carry(module.conv_shortcut, 1.0)
    elif kind == "Attention":
        module.to_out[0].weight.zero_()
        module.to_out[0].bias.zero_()
    elif kind == "Downsample2D":
        _carry(module.conv, 0.0)
        for channel in range(CARRIED):
            # The image is padded at the right and at the bottom.
            module.conv.weight[channel, channel, :2, :2] = 0.25
    elif kind == "Upsample2D":
        _carry(module.conv, 1.0)
        tent = torch.tensor([0.25, 0.5, 0.25])
        # The constants stay constant up to the border, so they are not smoothed.
        for channel in range(CARRIED - 2):
            module.conv.weight[channel, channel] = tent[:, None] * tent


def _carry(convolution: nn.Conv2d, gain: float) -> None:
    """Pass the carried channels on, multiplied by ``gain``, without adding others to them."""
    middle = convolution.weight.shape[-1] // 2
    convolution.weight[:CARRIED] = 0
    convolution.bias[:CARRIED] = 0
    for channel in range(CARRIED):
        convolution.weight[channel, channel, middle, middle] = gain


def _enter(convolution: nn.Conv2d) -> None:
    """Write each of the first three channels with both signs, and the constants, to the carried channels."""
    middle = convolution.weight.shape[-1] // 2
    convolution.weight[:CARRIED] = 0
    convolution.bias[:CARRIED] = 0
    for colour in range(3):
        convolution.weight[colour, colour, middle, middle] = 1
        convolution.weight[3 + colour, colour, middle, middle] = -1
    convolution.bias[CARRIED - 2], convolution.bias[CARRIED - 1] = LEVEL, -LEVEL


def _leave(convolution: nn.Conv2d) -> None:
    """Read each colour from its pair of channels."""
    middle = convolution.weight.shape[-1] // 2
    convolution.weight[:3] = 0
    convolution.bias[:3] = 0
    for colour in range(3):
        convolution.weight[colour, colour, middle, middle] = 1
        convolution.weight[colour, 3 + colour, middle, middle] = -1


def _calibrate(vae: AutoencoderKL, size: int) -> None:
    """Undo the factors of the normalisations, measured on random cells of colour."""
    generator = torch.Generator().manual_seed(0)
    cells = 2 * torch.rand(32, 3, size // FACTOR, size // FACTOR, generator=generator) - 1
    images = F.interpolate(cells, scale_factor=FACTOR)
    latents = vae.encode(images).latent_dist.mode()[:, :3]
    vae.encoder.conv_out.weight[:3] *= (cells * cells).sum() / (cells * latents).sum()
    decoded = F.avg_pool2d(vae.decode(vae.encode(images).latent_dist.mode()).sample, FACTOR)
    vae.decoder.conv_out.weight[:3] *= (cells * cells).sum() / (cells * decoded).sum()


@dataclass(frozen=True)
class Reconstruction:
    """The loss of the autoencoder, and its figures on held-out views."""

    vae: AutoencoderKL
    views: Groups
    held_out: Groups
    device: torch.device

    def loss(self, generator: torch.Generator) -> Tensor:
        """Return the error of colours and of differences between neighbours, and a small KL divergence."""
        rows = torch.randint(len(self.views), (GROUPS,), generator=generator)
        images, alpha = self.views.over(rows, backgrounds(GROUPS, generator))
        images, alpha = (x.flatten(0, 1).to(self.device) for x in (images, alpha))
        images = images.contiguous(memory_format=torch.channels_last)
        with torch.autocast(self.device.type, dtype=torch.bfloat16):
            posterior = self.vae.encode(images).latent_dist
            mean, log_variance = posterior.mean.float(), posterior.logvar.float()
            drawn = torch.randn(mean.shape, generator=generator).to(self.device)
            decoded = self.vae.decode(mean + (0.5 * log_variance).exp() * drawn).sample.float()
        weights = 1 + OBJECT_WEIGHT * alpha
        colours = ((decoded - images).abs() * weights).mean()
        edges = sum(
            ((a - b).abs()).mean() for a, b in zip(_differences(decoded), _differences(images), strict=True)
        )
        divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).flatten(1).sum(1).mean()
        return colours + edges + KL_WEIGHT * divergence

    @torch.no_grad()
    def figures(self) -> dict[str, float]:
        """Return the PSNR in decibels over held-out views, of whole images and of the object alone."""
        generator = torch.Generator().manual_seed(1)
        rows = torch.arange(len(self.held_out))
        images, alpha = self.held_out.over(rows, backgrounds(len(rows), generator))
        images, alpha = images.flatten(0, 1), alpha.flatten(0, 1)
        decoded = self.reconstructed(images)
        error = ((decoded - images) / 2).square()
        whole = error.mean((1, 2, 3))
        # A view with hardly any object in it has no PSNR of the object.
        seen = alpha.mean((1, 2, 3)) > 0.01
        inside = ((error * alpha).sum((1, 2, 3)) / (3 * alpha.sum((1, 2, 3))))[seen]
        return {"psnr": _decibels(whole), "object_psnr": _decibels(inside)}

    @torch.no_grad()
    def reconstructed(self, images: Tensor) -> Tensor:
        """Return images after encoding and decoding, in [-1, 1]."""
        parts = [
            self.vae.decode(self.vae.encode(part.to(self.device)).latent_dist.mode()).sample.clamp(-1, 1)
            for part in images.split(64)
        ]
        return torch.cat(parts).cpu()


@torch.no_grad()
def encode(vae: AutoencoderKL, views: Groups, seed: int, device: torch.device) -> Tensor:
    """Return the unscaled latents of all views, "g 4 c h w", each group over one background of its own."""
    generator = torch.Generator().manual_seed(seed)
    latents = []
    for rows in torch.arange(len(views)).split(16):
        images, _ = views.over(rows, backgrounds(len(rows), generator))
        flat = images.flatten(0, 1).to(device).contiguous(memory_format=torch.channels_last)
        mean = vae.encode(flat).latent_dist.mode().float().cpu()
        latents.append(mean.contiguous().unflatten(0, images.shape[:2]))
    return torch.cat(latents)


def _differences(images: Tensor) -> tuple[Tensor, Tensor]:
    return images[..., 1:, :] - images[..., :-1, :], images[..., 1:] - images[..., :-1]


def _decibels(errors: Tensor) -> float:
    return (-10 * errors.clamp_min(1e-10).log10()).mean().item()
