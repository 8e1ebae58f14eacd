"""Assets in Python: ``load`` reads one, and an ``Asset`` can be rendered, exported, meshed and shown."""

import html
import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from cadam3d.api.guest import as_guest, hinting, literal, logging_messages, plain, require_free, usual_modes
from cadam3d.build import option
from cadam3d.commands.export import export, set_title
from cadam3d.commands.messages import note_backend
from cadam3d.commands.opened import OpenedAsset, find_asset, find_run
from cadam3d.core.cameras import Cameras
from cadam3d.core.checks import fail, require_choice, require_whole
from cadam3d.core.console import show
from cadam3d.core.device import resolve_device
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.mesh.surface import SurfaceSettings
from cadam3d.core.rendering import RenderFn, RenderOutput, Subject
from cadam3d.exporter.html import UNTITLED, HtmlExporter
from cadam3d.exporter.images import ImagesExporter
from cadam3d.exporter.mesh import MeshExporter
from cadam3d.exporter.pictures import paint
from cadam3d.exporter.ply import PlyExporter
from cadam3d.io.asset_file import read_gaussians
from cadam3d.io.asset_record import facts_of
from cadam3d.io.atomic import replacing
from cadam3d.io.image import to_uint8
from cadam3d.io.run_folder import expanded, shown
from cadam3d.launch import completing, prepare
from cadam3d.rasterizer.base import Rasterizer, render_fn
from cadam3d.viewer.pack import pack
from cadam3d.viewer.page import viewer_page

if TYPE_CHECKING:
    import trimesh

VIEWS_AT_ONCE = 4  # bounds the memory of rendering many views
FRAME = (
    '<iframe srcdoc="{page}" title="{title}" sandbox="allow-scripts" allowfullscreen '
    'style="width: 100%; height: {height}px; border: 0"></iframe>'
)


@hinting(has_words=False)
@usual_modes()
def load(
    path: str | os.PathLike[str], *, up: str | None = None, device: str = "auto", rasterizer: str = "auto"
) -> "Asset":
    """Return the asset in a run folder, or in a file of any format that cadam3d reads.

    The format is recognised by the content: PLY, compressed PLY, glb, SPZ, SOG, ``.splat`` or ``.ksplat``.
    ``up`` is the up axis of a file that does not record it (``-y``, ``+y`` or ``+z``; None is -y). ``device``
    holds the Gaussians: ``auto`` is CUDA if there is one, else the CPU. ``rasterizer`` is an option of the
    group ``rasterizer``.

    Raises ``UserError`` if the folder or the file cannot be read.
    """
    place = expanded(os.fspath(path))
    renders = option("rasterizer", rasterizer, Rasterizer)
    # The name of something that does not exist means a folder if it has no suffix.
    if place.is_dir() or not (place.suffix or place.exists()):
        folder = find_run(str(place))
        place, prompt = find_asset(folder), facts_of(folder)["prompt"]
        # A stranger may have written the folder.
        title = prompt if isinstance(prompt, str) else None
    else:
        title = place.stem
    gaussians = read_gaussians(place, up=up, key="up").to(resolve_device(device))
    return Asset(gaussians, source=place, title=title, rasterizer=renders)


@dataclass(frozen=True, repr=False, eq=False)
class Asset:
    """3D Gaussians, such as a run's, with ways to look at them and to pass them on.

    ``len(asset)`` is the number of Gaussians. ``asset.gaussians`` are the tensors themselves.
    """

    gaussians: Gaussians
    source: Path | None = field(default=None, kw_only=True)  # the file they were read from
    title: str | None = field(default=None, kw_only=True)  # such as the prompt; None = "3D Gaussians"
    rasterizer: Rasterizer = field(
        default_factory=lambda: option("rasterizer", "auto", Rasterizer), kw_only=True
    )

    def __len__(self) -> int:
        return len(self.gaussians)

    def __repr__(self) -> str:
        facts = [f"{len(self):,} Gaussians", f"SH degree {self.gaussians.sh_degree}"]
        facts += [] if self.gaussians.device.type == "cpu" else [f"on {self.gaussians.device}"]
        facts += [] if self.title is None else [repr(self.title)]
        facts += [] if self.source is None else [f"from {shown(self.source)}"]
        return f"<Asset: {', '.join(facts)}>"

    @hinting(has_words=False)
    @usual_modes()
    def render(  # noqa: PLR0913  (one argument per setting)
        self,
        cameras: Cameras | None = None,
        *,
        kind: str = "rgb",
        background: Sequence[float] | np.ndarray | Tensor | str | None = None,
        views: int | None = None,
        elevation_deg: float | None = None,
        distance: float | None = None,
        fov_y_deg: float | None = None,
        size: int | None = None,
    ) -> UInt8[np.ndarray, "v h w c"]:
        """Return pictures as bytes from 0 to 255: one for each camera, or a turn around the object.

        ``kind`` is ``rgb``, ``depth`` (yellow is near), ``alpha`` or ``normal``. ``background`` is RGB in [0,
        1], or ``"transparent"``, which gives a fourth channel. The settings after it describe the turn:
        ``views`` pictures of ``size`` pixels, evenly spaced from the front on, ``elevation_deg`` above the
        horizon at ``distance`` world units with a vertical field of view of ``fov_y_deg``. ``None`` is the
        value in ``configs/exporter/images.yaml``. The pixels equal ``cadam3d render`` with the same
        settings.

        Raises ``UserError`` for values out of range.
        """
        turn = {"views": views, "distance": distance, "fov_y_deg": fov_y_deg, "size": size}
        turn["elevations_deg"] = None if elevation_deg is None else [elevation_deg]
        turn = {name: plain(value) for name, value in turn.items() if value is not None}
        if cameras is not None and turn:
            raise fail("cameras", expected="None with settings of a turn", got=turn, example="cameras=null")
        look = {"kinds": [kind]} | ({} if background is None else {"background": plain(background)})
        settings: ImagesExporter = option("exporter", "images", ImagesExporter, turn | look)
        if cameras is None:
            cameras = settings.ring(settings.views, settings.elevations_deg[0])
        else:
            settings = replace(settings, distance=float(cameras.positions.norm(dim=-1).mean()))
        subject = Subject(self.gaussians, self._render)
        pictures = []
        for first in range(0, len(cameras), VIEWS_AT_ONCE):
            some = cameras.index(slice(first, first + VIEWS_AT_ONCE))
            [painted] = paint(subject, some, settings, settings.kinds)
            pictures.append(to_uint8(painted))
        return np.concatenate(pictures)

    @hinting(has_words=False)
    @usual_modes()
    def rasterize(self, cameras: Cameras, background: Float[Tensor, "v 3"] | None = None) -> RenderOutput:
        """Return the exact numbers of a render, as tensors without gradient: rgb, alpha, depth and radii.

        ``background`` is one RGB colour in [0, 1] per view; None is black.
        """
        return self._render(cameras, torch.zeros(len(cameras), 3) if background is None else background)

    @property
    def _render(self) -> RenderFn:
        with logging_messages():
            note_backend(self.rasterizer.prepare(self.gaussians.device))
        return render_fn(self.rasterizer, lambda: self.gaussians)

    def export(self, path: str | os.PathLike[str], *overrides: str) -> list[Path]:
        """Write the asset for another program, and return the paths of the files.

        This is ``cadam3d export output=PATH OVERRIDES``. The suffix of ``path`` chooses the exporter, such as
        ``.ply``, ``.spz``, ``.glb`` or ``.html``. An override chooses another one of the same suffix or
        changes its settings, such as ``"exporter=[mesh]"`` or ``"exporter.ply.up=+z"``. A path without a
        suffix is a folder for the files of ``exporter=[...]`` or ``for=...``.

        Raises ``UserError`` if the settings are wrong or a file cannot be written.
        """
        place = os.fspath(path)
        require_free(overrides, {"output": place, "run": self, "ply": self})
        words = [literal("output", place), *overrides]
        with as_guest(), completing():
            cfg, _ = prepare("export", words)
            source = self.source or Path("asset")
            set_title(cfg, self.title)
            opened = OpenedAsset(self.gaussians, file=source, folder=source.parent)
            return [output.path for output in export(cfg, opened, "", has_record=False)]

    @hinting(has_words=False)
    @usual_modes()
    def simplified(
        self, count: int | None = None, *, fraction: float | None = None, simplify: str = "merge"
    ) -> "Asset":
        """Return this asset with ``count`` Gaussians, or with a ``fraction`` of them, without training.

        The file formats have the same three settings, which `cadam3d export --help exporter=ply` explains.
        An asset with fewer Gaussians stays as it is. Raises ``UserError`` for values out of range.
        """
        settings = {"count": plain(count), "fraction": plain(fraction), "simplify": simplify}
        exporter: PlyExporter = option("exporter", "ply", PlyExporter, settings)
        return replace(self, gaussians=exporter.simplified(self.gaussians, self.rasterizer.render))

    @usual_modes()
    def mesh(self, **settings: Any) -> "trimesh.Trimesh":
        """Return the outer surface as triangles with a colour per vertex, in world axes (+z up, front at +x).

        ``settings`` are ``resolution``, ``level``, ``smallest_part`` and ``triangles``, by default those in
        ``configs/exporter/mesh.yaml``. Raises ``UserError`` if the asset has no surface.
        """
        import trimesh

        for name in settings:
            require_choice("mesh", name, [each.name for each in fields(SurfaceSettings)])
        exporter: MeshExporter = option(
            "exporter", "mesh", MeshExporter, {name: plain(value) for name, value in settings.items()}
        )
        surface, _ = exporter.surface(self.gaussians)
        return trimesh.Trimesh(
            vertices=surface.vertices,
            faces=surface.faces,
            vertex_normals=surface.normals,
            vertex_colors=(surface.colors * 255).round().astype(np.uint8),
            process=False,
        )

    @hinting(has_words=False)
    @usual_modes()
    def show(self, *, height: int = 480) -> Path | None:
        """Show the asset in the output of a notebook, to turn and to zoom; ``height`` is in pixels.

        Outside of a notebook, write a page into a new temporary folder, print its path, and return it.
        """
        require_whole("height", height, low=1)
        title = self.title or UNTITLED
        page = viewer_page(pack(self.gaussians), title=title)
        shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
        if hasattr(shell, "kernel"):
            from IPython.display import display

            frame = FRAME.format(page=html.escape(page), title=html.escape(title), height=height)
            display({"text/html": frame, "text/plain": repr(self)}, raw=True)
            return None
        path = Path(tempfile.mkdtemp(prefix="cadam3d-"), *HtmlExporter.files)
        with replacing(path) as temporary:
            temporary.write_text(page, encoding="utf-8")
        show(f"Open this in a browser: {path}")
        return path
