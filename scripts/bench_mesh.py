"""Measure meshes of trained assets of the shapes prior: their errors, their triangles and the seconds.

    cadam3d train prompt="a snowman" hydra.run.dir=runs/snowman
    python scripts/bench_mesh.py runs/snowman

The settings are those of configs/exporter/mesh.yaml and configs/metric/mesh.yaml. The seconds are CPU time of
the exporter on one thread, writing the glb included. The prompt is read from the run.
"""

import tempfile
import time
from pathlib import Path

import measuring
import torch
from omegaconf import OmegaConf
from torch import Tensor

from cadam3d.build import component
from cadam3d.core.cameras import Cameras
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.mesh.distance import true_surfaces
from cadam3d.core.rendering import RenderOutput
from cadam3d.exporter.base import Exporter
from cadam3d.io.mesh import read_mesh
from cadam3d.io.ply import read_ply
from cadam3d.io.run_folder import ASSET, CONFIG
from cadam3d.metric.mesh import MeshMetric, distances_between, f_score
from cadam3d.prior.shapes.scene import build, signed_distance
from cadam3d.settings.compose import compose


def no_pictures(cameras: Cameras, background: Tensor, shown: Gaussians | None = None) -> RenderOutput:
    """Refuse to render, because a mesh needs no picture."""
    raise AssertionError("the exporter of meshes renders nothing")


def measure(run: Path, exporter: Exporter, metric: MeshMetric) -> dict[str, object]:
    """Return the row of the table for one run."""
    prompt = OmegaConf.load(run / CONFIG).prompt
    gaussians = read_ply(run / ASSET)
    with tempfile.TemporaryDirectory() as folder:
        begin = time.process_time()
        [path] = exporter.export(gaussians, no_pictures, Path(folder))
        seconds = time.process_time() - begin
        mesh = read_mesh(path)
    surface, _ = metric.surface(gaussians)
    scene = build(prompt).to(torch.device("cpu"), torch.float64)
    [truth] = true_surfaces(lambda points: signed_distance(scene, points)[None])
    to_true, to_mesh = distances_between(
        (surface.vertices, surface.faces), truth, metric.samples, metric.seed
    )
    chamfer = (to_true.mean() + to_mesh.mean()) / 2
    return {
        "prompt": prompt,
        "triangles": len(mesh.faces),
        "parts": mesh.body_count,
        "watertight": "yes" if mesh.is_watertight else "no",
        "Chamfer": f"{chamfer:.4f}",
        "F at 0.01": f"{f_score(to_true, to_mesh, 0.01)[0]:.3f}",
        "F at 0.02": f"{f_score(to_true, to_mesh, 0.02)[0]:.3f}",
        "seconds": f"{seconds:.1f}",
    }


def main() -> None:
    """Print the table."""
    parser = measuring.parser_of(__doc__)
    parser.add_argument("runs", nargs="+", type=Path, help="folders of runs with prior=shapes")
    runs = parser.parse_args().runs
    torch.set_num_threads(1)
    cfg = compose(["prompt=a cube", "exporter=[mesh]", "metric=[mesh]"])
    exporter = component(cfg.exporter.mesh, Exporter, "exporter.mesh")
    metric = component(cfg.metric.mesh, MeshMetric, "metric.mesh")
    print(measuring.table([measure(run, exporter, metric) for run in runs]))


if __name__ == "__main__":
    main()
