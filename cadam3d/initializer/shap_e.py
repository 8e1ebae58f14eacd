"""Shap-E: an initial shape generated from the prompt (Jun and Nichol 2023), through diffusers."""

import gc
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from jaxtyping import Float, Int
from kornia.color import linear_rgb_to_rgb
from torch import Tensor

from cadam3d.core.checks import Color, Positive, Share, one_of, whole, within
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.initializer.base import Beginning, Initializer
from cadam3d.initializer.points import (
    Copies,
    FromObject,
    PointCloud,
    Radius,
    ReplicateLaw,
    Rows,
    grown,
    one_color,
    points_on_surface,
    replicated,
)
from cadam3d.io.frames import turned_points
from cadam3d.io.pretrained import DTYPES, ModelSource, Pretrained

KIND = "ShapEPipeline"
# Colours of the model: as in its own pictures, or in linear light, as its decoder returns them.
TONES = ("srgb", "linear")
# What to type instead of a pipeline that cannot be used.
OTHERS = {"ShapEImg2ImgPipeline": "'initializer.ids=[openai/shap-e]', which reads text instead of images"}


@dataclass(frozen=True)
class ColoredMesh:
    """Triangles in Shap-E's coordinates: z up, inside the cube from -1 to 1, mostly in its inner half."""

    vertices: Float[Tensor, "m 3"]
    faces: Int[Tensor, "f 3"]
    rgb: Float[Tensor, "m 3"]  # of the vertices, in [0, 1]


@dataclass(frozen=True, kw_only=True)
class ShapE(FromObject):
    """Gaussians at the vertices, or at random points, of the mesh that Shap-E generates from the prompt.

    The points can be grown or replicated. The parts of the model are loaded one after the other and freed
    before training. If the model is not available or finds no surface, ``fallback`` builds the Gaussians
    and the run reports it; without a fallback that is an error.
    """

    path: str | None  # folder
    ids: Sequence[str]  # on the hub
    revision: str | None  # on the hub
    variant: str | None  # of weight files
    dtype: Annotated[str, one_of(("auto", *DTYPES))]
    prompt: str | None
    steps: Annotated[int, whole(low=1, high=1024)]
    guidance_scale: Annotated[float, within(low=1)]
    grid_size: Annotated[int, whole(low=2, high=1024)]  # cells per side
    count: Rows | None
    grow_points: Annotated[int, whole(low=0, high=100_000_000)]  # candidates
    grow_distance: Positive  # Shap-E's units
    grow_noise: Share
    tone: Annotated[str, one_of(TONES)]
    color: Color | None
    replicate: Copies  # Gaussians per point
    replicate_radius: Radius  # world units
    replicate_law: ReplicateLaw
    fallback: Initializer | None

    def begin(self, prompt: str, generator: torch.Generator, device: torch.device) -> Beginning:
        """Return Shap-E's Gaussians, or the Gaussians of ``fallback`` with a note if Shap-E fails.

        Raises ``UserError`` if Shap-E fails and there is no fallback.
        """
        before = generator.get_state()
        try:
            return Beginning(self.build(prompt, generator, device))
        except UserError as error:
            if self.fallback is None:
                raise
            # Rewind, so that the run equals one that was started with the fallback.
            generator.set_state(before)
            instead = self.fallback.begin(prompt, generator, device)
            name = type(self.fallback).__name__
            return Beginning(instead.gaussians, f"{name} is used instead of Shap-E. {error}")

    def build(self, prompt: str, generator: torch.Generator, device: torch.device) -> Gaussians:
        """Return Gaussians on ``device`` at points of the generated mesh.

        Raises ``UserError`` if the model is not available, does not fit into memory or finds no surface.
        """
        source = ModelSource("initializer", self.path, self.ids, self.revision, self.variant)
        found = source.find((KIND,), OTHERS)
        try:
            latent = self.sample(found, prompt, generator, device)
            mesh = self.decode(found, latent)
        except torch.OutOfMemoryError as error:
            raise UserError(
                f"initializer: Shap-E does not fit into the memory of {device}. "
                f"Try: initializer.dtype=float16 initializer.grid_size={max(self.grid_size // 2, 2)}"
            ) from error
        finally:
            gc.collect()
            if torch.cuda.is_available():
                torch.cuda.empty_cache()
        return self.settle(mesh, generator, device)

    def sample(
        self, found: Pretrained, prompt: str, generator: torch.Generator, device: torch.device
    ) -> Float[Tensor, "1 k d"]:
        """Draw and denoise the latent that describes an object of the prompt, on ``device``."""
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
        # The latent itself stays float32: its initial noise is so large that half precision loses the object.
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
        """Return the surface that a latent describes, on the CPU. Raises ``UserError`` if there is none."""
        # Always float32: positions are encoded with frequencies up to 2^14, too high for half precision.
        renderer = found.part("shap_e_renderer", torch.float32).to(latent.device)
        renderer.mesh_decoder.register_forward_hook(_refuse_empty_mesh)
        mesh = renderer.decode_to_mesh(latent, latent.device, grid_size=self.grid_size)
        # The decoder returns colours in linear light.
        rgb = torch.stack([mesh.vertex_channels[channel] for channel in "RGB"])
        if self.tone == "srgb":
            rgb = linear_rgb_to_rgb(rgb[..., None])[..., 0]
        return ColoredMesh(mesh.verts.cpu(), mesh.faces.cpu(), rgb.T.clamp(0, 1).cpu())

    def settle(self, mesh: ColoredMesh, generator: torch.Generator, device: torch.device) -> Gaussians:
        """Return Gaussians on ``device`` at points of a mesh that Shap-E decoded."""
        cloud = PointCloud(mesh.vertices, mesh.rgb)
        if self.count is not None:
            corners, colors = mesh.vertices[mesh.faces], mesh.rgb[mesh.faces]
            faces, weights = points_on_surface(corners, self.count, generator)
            weights = weights[..., None]
            cloud = PointCloud((weights * corners[faces]).sum(dim=1), (weights * colors[faces]).sum(dim=1))
        if self.grow_points > 0:
            cloud = grown(cloud, self.grow_points, self.grow_distance, self.grow_noise, generator)
        upright = turned_points(cloud.points, self.turn_deg)
        rgb = cloud.rgb if self.color is None else one_color(self.color, len(cloud))
        cloud = PointCloud(self.placed(upright)[0], rgb)
        cloud = replicated(cloud, self.replicate, self.replicate_radius, generator, self.replicate_law)
        return self.gaussians_at(cloud, device)


def _refuse_empty_mesh(_decoder: object, _inputs: object, mesh: Any) -> None:
    """Raise ``UserError`` for an empty mesh.

    This hook runs after the marching cubes, because the code of diffusers that follows fails on such a mesh.
    """
    if len(mesh.faces) == 0:
        raise UserError(
            "initializer: Shap-E found no surface for this prompt. Another seed or a simpler description "
            "may help. Try: 'initializer.prompt=a chair'"
        )
