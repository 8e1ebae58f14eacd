"""Shap-E: a first guess of the shape from the prompt (Jun and Nichol 2023), through diffusers."""

import gc
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from kornia.color import linear_rgb_to_rgb
from torch import Tensor

from cadam3d.core.checks import UserError, require, require_choice, require_range, require_whole
from cadam3d.core.gaussians import Gaussians
from cadam3d.initializer.base import Beginning, Initializer
from cadam3d.initializer.points import (
    PointCloud,
    fit,
    gaussians_at,
    grown,
    points_on_surface,
    replicated,
    require_copies,
    require_place,
    require_points,
)
from cadam3d.io.frames import turned_points
from cadam3d.io.pretrained import DTYPES, Pretrained, Source

KIND = "ShapEPipeline"
OTHERS = {"ShapEImg2ImgPipeline": "initializer.ids=[openai/shap-e], which reads text; this one reads images"}


@dataclass(frozen=True)
class ColoredMesh:
    """Triangles in Shap-E's frame: z up, inside the cube from -1 to 1, most of it within half of that."""

    vertices: Float[Tensor, "m 3"]
    faces: Int[Tensor, "f 3"]
    rgb: Float[Tensor, "m 3"]  # of the vertices, in [0, 1]


@dataclass(frozen=True, kw_only=True)
class ShapE(Initializer):
    """The mesh that Shap-E makes of the prompt: its vertices or random points of it, grown or replicated.

    Its parts are loaded one after the other and freed before training. Where the model cannot be had, or
    finds no surface, ``fallback`` builds instead and the run says so; without one that is an error.
    """

    path: str | None  # a folder in the layout of diffusers; wins over ids
    ids: Sequence[str]  # names on the hub, tried in order
    revision: str | None  # on the hub
    variant: str | None  # of weight files
    dtype: str  # of text encoder and denoiser: one of DTYPES, or "auto": float16 on CUDA, float32 elsewhere
    prompt: str | None  # Shap-E's own; None = that of the run
    steps: int  # of denoising
    guidance_scale: float  # 1 = no guidance
    grid_size: int  # cells per side of the grid on which the surface is sought
    turn_deg: int  # about the up axis, counterclockwise from above: 0, 90, 180 or 270
    radius: float | None  # world units from the centre of the bounding box to the farthest; null = as it is
    count: int | None  # random points of the surface; null = the vertices
    grow_points: int  # candidates in the bounding box; 0 = nothing grows
    grow_distance: float  # Shap-E's units: candidates this near to a point of the surface stay
    grow_noise: float  # at most so much is added to each channel of their colours
    replicate: int  # Gaussians for each point
    replicate_radius: float  # world units; of the ball that holds them
    scale: float | None  # world units; null = mean distance to the three nearest neighbours
    opacity: float  # in (0, 1)
    sh_degree: int  # of the colours, 0 to 3
    fallback: Initializer | None

    def __post_init__(self) -> None:
        self._source()
        require_choice("initializer.dtype", self.dtype, ("auto", *DTYPES))
        is_text = self.prompt is None or (isinstance(self.prompt, str) and self.prompt.strip() != "")
        example = "initializer.prompt=null"
        require(is_text, "initializer.prompt", expected="a text or null", got=self.prompt, example=example)
        require_whole("initializer.steps", self.steps, low=1, high=1024, example=64)
        require_range("initializer.guidance_scale", self.guidance_scale, low=1, example=15)
        require_whole("initializer.grid_size", self.grid_size, low=2, example=128)
        require_place(self.turn_deg, self.radius)
        require_points(1 if self.count is None else self.count, self.scale, self.opacity, self.sh_degree)
        require_whole("initializer.grow_points", self.grow_points, low=0, example=1000000)
        require_range("initializer.grow_distance", self.grow_distance, above=0, example=0.01)
        require_range("initializer.grow_noise", self.grow_noise, low=0, high=1, example=0.2)
        require_copies(self.replicate, self.replicate_radius)
        require(
            self.fallback is None or hasattr(self.fallback, "begin"),
            "initializer.fallback",
            expected="an initializer or null",
            got=self.fallback,
            example="initializer/fallback=ball",
        )

    def begin(self, prompt: str, generator: torch.Generator, device: torch.device) -> Beginning:
        """What Shap-E makes of the prompt, or else what ``fallback`` builds, as if it had been asked for."""
        before = generator.get_state()
        try:
            return Beginning(self.build(prompt, generator, device))
        except UserError as error:
            if self.fallback is None:
                raise
            generator.set_state(before)  # so the run equals one that was started with the fallback
            instead = self.fallback.begin(prompt, generator, device)
            note = f"{type(self.fallback).__name__} stands in for Shap-E. {error}"
            return Beginning(instead.gaussians, f"{note} {instead.note}" if instead.note else note)

    def build(self, prompt: str, generator: torch.Generator, device: torch.device) -> Gaussians:
        """Gaussians at points of the mesh.

        Raises ``UserError`` if the model cannot be had, does not fit into memory or finds no surface.
        """
        found = self._source().find((KIND,), OTHERS)
        try:
            latent = self.sample(found, prompt, generator, device)
            mesh = self.decode(found, latent)
        except torch.OutOfMemoryError as error:
            raise UserError(
                f"initializer: Shap-E does not fit into the memory of {device}. "
                "Try: initializer.dtype=float16, or a smaller initializer.grid_size"
            ) from error
        finally:
            _free()
        return self.settle(mesh, generator, device)

    def sample(
        self, found: Pretrained, prompt: str, generator: torch.Generator, device: torch.device
    ) -> Float[Tensor, "1 k d"]:
        """Draw and denoise the latent that describes an object for the prompt, on ``device``."""
        from diffusers import ShapEPipeline

        half = torch.float16 if device.type == "cuda" else torch.float32
        dtype = half if self.dtype == "auto" else DTYPES[self.dtype]
        denoiser = found.part("prior", dtype).to(device)
        parts: dict[str, Any] = {
            "prior": denoiser,
            "text_encoder": found.part("text_encoder", dtype).to(device),
            "tokenizer": found.part("tokenizer"),
            "scheduler": found.part("scheduler"),
            "shap_e_renderer": None,
        }
        pipeline = ShapEPipeline(**parts)
        pipeline.set_progress_bar_config(desc="Shap-E", leave=False, disable=None)
        numbers = denoiser.config.num_embeddings * denoiser.config.embedding_dim
        noise = torch.randn(1, numbers, generator=generator).to(device)
        # The latent itself stays float32: beside its noise at the start, half precision loses the object.
        with torch.autocast(device.type, dtype, enabled=dtype != torch.float32):
            output: Any = pipeline(
                self.prompt or prompt,
                num_inference_steps=self.steps,
                guidance_scale=self.guidance_scale,
                latents=noise,
                output_type="latent",
            )
        return output.images.float()

    def decode(self, found: Pretrained, latent: Float[Tensor, "1 k d"]) -> ColoredMesh:
        """The surface that a latent describes, on the CPU. Raises ``UserError`` if there is none."""
        # Always float32: positions are encoded in frequencies up to 2^14, of which half precision sees few.
        renderer = found.part("shap_e_renderer", torch.float32).to(latent.device)
        renderer.mesh_decoder.register_forward_hook(_refuse_nothing)
        mesh = renderer.decode_to_mesh(latent, latent.device, grid_size=self.grid_size)
        linear = torch.stack([mesh.vertex_channels[channel] for channel in "RGB"])
        rgb = linear_rgb_to_rgb(linear[..., None])[..., 0].T  # the decoder says what a light would meet
        return ColoredMesh(mesh.verts.cpu(), mesh.faces.cpu(), rgb.clamp(0, 1).cpu())

    def settle(self, mesh: ColoredMesh, generator: torch.Generator, device: torch.device) -> Gaussians:
        """Gaussians at points of a mesh that Shap-E decoded."""
        cloud = self._points(mesh, generator)
        if self.grow_points > 0:
            cloud = grown(cloud, self.grow_points, self.grow_distance, self.grow_noise, generator)
        upright = turned_points(cloud.points, self.turn_deg)
        center, factor = fit(upright, self.radius)
        cloud = PointCloud((upright - center) * factor, cloud.rgb)
        cloud = replicated(cloud, self.replicate, self.replicate_radius, generator).to(device)
        return gaussians_at(cloud, scale=self.scale, opacity=self.opacity, sh_degree=self.sh_degree)

    def _points(self, mesh: ColoredMesh, generator: torch.Generator) -> PointCloud:
        if self.count is None:
            return PointCloud(mesh.vertices, mesh.rgb)
        corners, colors = mesh.vertices[mesh.faces], mesh.rgb[mesh.faces]
        faces, weights = points_on_surface(corners, self.count, generator)
        weights = weights[..., None]
        return PointCloud((weights * corners[faces]).sum(dim=1), (weights * colors[faces]).sum(dim=1))

    def _source(self) -> Source:
        return Source("initializer", self.path, self.ids, self.revision, self.variant)


def _refuse_nothing(_decoder: object, _inputs: object, mesh: Any) -> None:
    """A hook behind the marching cubes, for what follows in diffusers breaks on a mesh of nothing."""
    if len(mesh.faces) == 0:
        raise UserError(
            "initializer: Shap-E found no surface for this prompt. Try: another seed, or initializer.prompt="
            "'a simpler description'"
        )


def _free() -> None:
    gc.collect()
    if torch.cuda.is_available():
        torch.cuda.empty_cache()
