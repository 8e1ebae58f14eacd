"""The denoiser and its text encoders, trained together on the latents of all views."""

from dataclasses import dataclass
from typing import Any

import torch
from prior_training.formats import Format, camera_rows
from prior_training.text import Captions
from prior_training.views import Groups
from torch import Tensor, nn

IMAGES = 32  # per step and process
# The levels of noise at which the error on held-out views is measured.
LEVELS = (0.1, 0.3, 0.5, 0.7, 0.9)


@dataclass(frozen=True)
class Encoded:
    """Views as latents, with their captions and cameras."""

    latents: Tensor  # "g 4 c h w", shifted and scaled
    captions: Captions
    cameras: Tensor  # "g 4 16"

    @classmethod
    def of(cls, views: Groups, latents: Tensor, kind: Format, tokenizer: Any) -> "Encoded":
        """Return the views with the captions of this format."""
        rows = camera_rows(views.azimuth_deg.flatten(), views.elevation_deg.flatten())
        captions = Captions(views, kind.wording, tokenizer)
        return cls(latents, captions, rows.unflatten(0, views.azimuth_deg.shape))


@dataclass(frozen=True)
class Denoising:
    """The loss of the denoiser, and its figures on held-out views."""

    kind: Format
    model: nn.ModuleDict
    views: Encoded
    held_out: Encoded
    device: torch.device

    def loss(self, generator: torch.Generator) -> Tensor:
        """Return the mean squared error of the prediction, at levels of noise that are spread evenly."""
        together = self.kind.group
        count = IMAGES // together
        groups = torch.randint(len(self.views.latents), (count,), generator=generator)
        if together == 1:
            chosen = 4 * groups + torch.randint(4, (count,), generator=generator)
        else:
            chosen = (4 * groups[:, None] + torch.arange(4)).flatten()
        level = (torch.arange(count) + torch.rand(count, generator=generator)) / count
        texts = self.views.captions.texts(chosen, together, generator)
        return self._errors(self.views, chosen, texts, level.repeat_interleave(together), generator).mean()

    @torch.no_grad()
    def figures(self) -> dict[str, Any]:
        """Return the mean squared error per level of noise, with the right, no and a wrong caption."""
        views = torch.arange(min(4 * len(self.held_out.latents), 256))
        right = self.held_out.captions.right(views)
        # A wrong caption is that of the view seven groups (28 views) further on, which shows another object.
        ways = {"right": right, "empty": [""] * len(right), "wrong": right[28:] + right[:28]}
        return {
            name: [round(self._error(views, texts, level), 4) for level in LEVELS]
            for name, texts in ways.items()
        }

    def _error(self, views: Tensor, texts: list[str], level: float) -> float:
        generator = torch.Generator().manual_seed(1)
        errors = []
        for part in views.split(64):
            own = texts[int(part[0]) : int(part[-1]) + 1]
            errors.append(self._errors(self.held_out, part, own, torch.full((len(part),), level), generator))
        return float(torch.cat(errors).mean())

    def _errors(
        self, views: Encoded, chosen: Tensor, texts: list[str], level: Tensor, generator: torch.Generator
    ) -> Tensor:
        latents = views.latents.flatten(0, 1)[chosen]
        noise = torch.randn(latents.shape, generator=generator)
        cameras = views.cameras.flatten(0, 1)[chosen]
        numbers = views.captions.numbers(texts)
        latents, noise, level, numbers, cameras = (
            x.to(self.device) for x in (latents, noise, level, numbers, cameras)
        )
        noised = self.kind.noised(latents, noise, level)
        output = self.kind.predict(self.model, noised, numbers, cameras)
        return (output.float() - noised.target).square().mean((1, 2, 3))
