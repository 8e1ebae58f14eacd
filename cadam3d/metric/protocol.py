"""Protocol: how an asset is shown to a model that scores pictures, and how the scores become one number.

The score of a picture means little without its protocol: another background, elevation or model changes it
by more than the difference between methods. A protocol therefore has a name, and all its settings are in the
record of every number that was measured with it.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.cameras import Cameras, orbit
from cadam3d.core.checks import each, whole, within
from cadam3d.core.pictures import Elevations, PictureSettings, Views
from cadam3d.core.rendering import RenderFn

# Views that are rendered and scored at once, which bounds the memory.
VIEWS_AT_ONCE = 4
PROMPT = "{}"  # the place of the prompt in a text


@dataclass(frozen=True, kw_only=True)
class Protocol(PictureSettings, ABC):
    """Views, pictures, text and models of an evaluation. The subclasses place the cameras."""

    is_mean: ClassVar[bool]  # whether the number is the mean of the values, so that it has an interval

    name: str
    text: str  # what the picture is compared with; {} is the prompt
    models: Mapping[str, str | None]  # from the name of a scorer, such as "clip", to OWNER/NAME@COMMIT

    def __post_init__(self) -> None:
        super().__post_init__()
        is_text = self.text.count(PROMPT) == 1
        self.expect(is_text, "text", f"a text with {PROMPT} once")

    @cached_property
    @abstractmethod
    def cameras(self) -> Cameras:
        """Return the cameras of all views."""

    @abstractmethod
    def aggregate(self, values: Float[Tensor, "v"], *, less_is_better: bool) -> float:
        """Return the one number that the values of all views become."""

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


@dataclass(frozen=True, kw_only=True)
class RingProtocol(Protocol):
    """Views that are evenly spaced on rings, one ring per elevation; the first of each sees the front."""

    is_mean: ClassVar[bool] = True

    views: Views  # per elevation
    elevations_deg: Elevations

    @cached_property
    def cameras(self) -> Cameras:
        """Return the cameras, ring by ring."""
        azimuth = torch.arange(self.views, dtype=torch.float32) * (360.0 / self.views)
        elevation = torch.tensor([float(angle) for angle in self.elevations_deg])
        return self.cameras_at(azimuth.repeat(len(elevation)), elevation.repeat_interleave(self.views))

    def aggregate(self, values: Float[Tensor, "v"], *, less_is_better: bool) -> float:
        """Return the mean."""
        return float(values.mean())


@dataclass(frozen=True, kw_only=True)
class SphereProtocol(Protocol):
    """Views from the vertices of an icosahedron whose faces are divided, with several fields of view each.

    This is how T3Bench (He et al. 2023) measures the quality of an asset. The best field of view counts for
    each vertex. Then the values of all vertices are smoothed ``rounds`` times, by the mean over a vertex and
    its neighbours, so that one lucky view does not decide. The best vertex counts.
    """

    is_mean: ClassVar[bool] = False

    subdivisions: Annotated[int, whole(low=0, high=4)]  # each divides every triangle into four
    # More fields of view beside ``fov_y_deg``.
    other_fovs_y_deg: Annotated[Sequence[float], each(within(above=0, below=180))]
    rounds: Annotated[int, whole(low=0, high=100)]  # of smoothing

    @cached_property
    def cameras(self) -> Cameras:
        """Return the cameras: all fields of view of the first vertex, then of the second, and so on."""
        x, y, z = torch.tensor(self._mesh.vertices, dtype=torch.float64).unbind(dim=1)
        azimuth, elevation = torch.rad2deg(torch.atan2(y, x)), torch.rad2deg(torch.asin(z.clamp(-1, 1)))
        fovs = torch.tensor([float(each) for each in (self.fov_y_deg, *self.other_fovs_y_deg)])
        azimuth, elevation = (each.repeat_interleave(len(fovs)).float() for each in (azimuth, elevation))
        full = torch.full_like(azimuth, float(self.distance))
        return orbit(azimuth, elevation, full, fovs.repeat(len(x)), self.size, self.size)

    def aggregate(self, values: Float[Tensor, "v"], *, less_is_better: bool) -> float:
        """Return the smoothed value of the best vertex."""
        by_vertex = values.double().reshape(len(self._mesh.vertices), -1)
        field = by_vertex.amin(dim=1) if less_is_better else by_vertex.amax(dim=1)
        # Each vertex is a neighbour of itself.
        near = torch.eye(len(field), dtype=torch.float64)
        one, other = torch.tensor(self._mesh.edges_unique).T
        near[one, other] = near[other, one] = 1
        for _ in range(self.rounds):
            field = near @ field / near.sum(dim=1)
        return float(field.min() if less_is_better else field.max())

    @cached_property
    def _mesh(self) -> Any:
        """Return the sphere as a mesh of trimesh.

        It stands on an edge: the poles are in the middle of two edges of the undivided icosahedron.
        """
        from trimesh.creation import icosphere  # slow to import

        return icosphere(subdivisions=self.subdivisions)
