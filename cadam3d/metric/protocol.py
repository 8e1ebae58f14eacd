"""Protocol: how an asset is shown to a model that scores pictures, and how the scores become one number.

The score of a picture means little without its protocol: another background, elevation or model changes it
by more than the difference between methods. A protocol therefore has a name, and all its settings are in the
record of every number that was measured with it.
"""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras
from cadam3d.core.pictures import Elevations, PictureSettings, Views
from cadam3d.core.rendering import RenderFn

# Views that are rendered and scored at once, which bounds the memory.
VIEWS_AT_ONCE = 4
PROMPT = "{}"  # the place of the prompt in a text


@dataclass(frozen=True, kw_only=True)
class Protocol(PictureSettings):
    """Views, pictures, text and models of an evaluation. The number of an asset is the mean over its views.

    The views are evenly spaced on rings, one ring per elevation; the first of each sees the front.
    """

    name: str
    text: str  # what the picture is compared with; {} is the prompt
    models: Mapping[str, str | None]  # from the name of a scorer, such as "clip", to OWNER/NAME@COMMIT
    views: Views  # per elevation
    elevations_deg: Elevations

    def __post_init__(self) -> None:
        super().__post_init__()
        is_text = self.text.count(PROMPT) == 1
        self.expect(is_text, "text", f"a text with {PROMPT} once")

    @cached_property
    def cameras(self) -> Cameras:
        """Return the cameras of all views, ring by ring."""
        azimuth = torch.arange(self.views, dtype=torch.float32) * (360.0 / self.views)
        elevation = torch.tensor([float(angle) for angle in self.elevations_deg])
        return self.cameras_at(azimuth.repeat(len(elevation)), elevation.repeat_interleave(self.views))

    def text_of(self, prompt: str) -> str:
        """Return the text with which the pictures are compared."""
        return self.text.replace(PROMPT, prompt)

    def images(self, render: RenderFn) -> Iterator[Float[Tensor, "v h w 3"]]:
        """Yield the pictures of the asset that ``render`` shows, in [0, 1], a few views at a time."""
        for some in self.cameras.parts(VIEWS_AT_ONCE):
            yield render(some, self.backgrounds(len(some))).rgb.detach().float().clamp(0, 1)

    def record(self) -> dict[str, Any]:
        """Return all settings as plain data, for the record of a number; models are recorded with it."""
        settings = {key: value for key, value in asdict(self).items() if key != "models"}
        return {key: list(value) if isinstance(value, tuple) else value for key, value in settings.items()}
