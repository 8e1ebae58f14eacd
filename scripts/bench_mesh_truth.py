"""Measure the exact images of textured meshes: loading, training steps, and the z-buffer beside Embree.

    python scripts/bench_mesh_truth.py

The meshes are objects of the world, tessellated by halving all edges. Each row is the smallest of its turns.
One thread is timed by the clock of the process, which leaves out other processes, and several threads by the
wall clock. Rays of Embree are timed only if ``embreex`` is installed: first with one ray per point of the
picture and the triangle that it hits, without the barycentric weights that the z-buffer returns too, and
then with the time to build its tree, which a scene needs once.
"""

import argparse
import os
import sys
import tempfile
from collections.abc import Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

# The script measures the package that it stands beside, from any folder.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from cadam3d.core.openmp import waiting

# As on the command line, and before torch is loaded: idle threads of torch leave the processor to others.
os.environ.update(waiting(os.environ))

import torch
import trimesh
from measuring import HERE, in_checkout, in_turns, milliseconds, parser_of, peak_bytes, positive, table

from cadam3d.core.cameras import Cameras, fitting_distance, turntable
from cadam3d.core.mesh.textured import TexturedMesh
from cadam3d.prior.objects.catalog import WORLD
from cadam3d.prior.objects.scene import read_object
from cadam3d.prior.objects.zbuffer import first_hits

CPU = torch.device("cpu")
FOV_DEG = 40.0
# Objects and how often their edges are halved.
RAYS, STEPS, LOADED = [("horse", 0), ("horse", 2), ("horse", 4)], ("chicken", 2), ("wooden_puppet", 3)


def write_tessellated(folder: Path, name: str, times: int) -> Path:
    """Write an object with 4**times as many triangles, and return the path of the file."""
    path = folder / f"{name}_{times}.glb"
    scene = trimesh.load_scene(WORLD / f"{name}.glb")
    for part in scene.geometry:
        for _ in range(times):
            scene.geometry[part] = scene.geometry[part].subdivide()
    scene.export(path)
    return path


def read(path: Path) -> TexturedMesh:
    """Return the mesh of a file with its normals."""
    mesh = read_object(str(path), "prior.path", "+y").to(CPU, torch.float32)
    assert mesh.normals.isfinite().all()
    return mesh


def rays_of(cameras: Cameras) -> tuple[Any, Any]:
    """Return the origins and the directions of the rays through all pixel centres of the first view."""
    y, x = torch.meshgrid(torch.arange(cameras.height), torch.arange(cameras.width), indexing="ij")
    points = torch.stack([x + 0.5, y + 0.5, torch.ones_like(x)], dim=-1).reshape(-1, 3)
    directions = points @ torch.linalg.inv(cameras.intrinsics[0]).T @ cameras.world_to_camera[0, :3, :3]
    return cameras.positions[:1].expand_as(directions).contiguous().numpy(), directions.contiguous().numpy()


def compare_hits(folder: Path, args: argparse.Namespace) -> None:
    """Print the time of the hits of one view for each mesh and size."""
    rows = []
    for name, times in RAYS:
        mesh = read(write_tessellated(folder, name, times))
        solid = trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False)
        for size in args.sizes:
            cameras = turntable(
                1, elevation_deg=15.0, distance=fitting_distance(FOV_DEG), fov_y_deg=FOV_DEG, size=size
            )
            works = {"z-buffer": partial(first_hits, mesh.corners, cameras, 0)}
            if find_spec("embreex"):
                works |= embree(solid, *rays_of(cameras))
            timed = {name: partial(milliseconds, work, CPU, times=3) for name, work in works.items()}
            found = {key: min(turns) for key, turns in in_turns(timed, args.repeats).items()}
            row = {"object": name, "triangles": f"{len(mesh.faces):,}", "size": size}
            rows.append(row | {f"{key}, ms": f"{value:.2f}" for key, value in found.items()})
    print(table(rows), "\n")


def embree(solid: trimesh.Trimesh, origins: Any, directions: Any) -> dict[str, Any]:
    """Return the calls of Embree: rays against a tree that exists, and the building of one."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    corners = solid.triangles.astype("float32")

    def tree() -> Any:
        scene = EmbreeScene()
        TriangleMesh(scene, corners)
        scene.run(origins[:1], directions[:1])  # builds it
        return scene

    return {"Embree": partial(tree().run, origins, directions), "its tree": tree}


def compare_steps(path: Path, args: argparse.Namespace) -> None:
    """Print the time of a training step with a mesh beside that with a procedural shape."""
    settings = ["camera.size=112", "views=2", "truth=none"]
    works = {
        f"{prior}, {threads} threads": partial(
            in_checkout,
            str(Path(__file__).with_name("bench_step.py")),
            HERE,
            ["--priors", prior, "--threads", str(threads), "--steps", str(args.steps), *words, *settings],
        )
        for threads in args.threads
        for prior, words in {"exact": [], "mesh": [f"prior.path={path}"]}.items()
    }
    rows = []
    for name, turns in in_turns(works, args.turns).items():
        wall, cpu = (min(turn[key] for turn in turns) for key in ("wall_ms", "cpu_ms"))
        condition = min(turn["parts_ms"]["condition"] for turn in turns)
        row = {"prior": name, "wall, ms": f"{wall:.1f}", "CPU, ms": f"{cpu:.1f}"}
        row |= {"images, ms": f"{condition:.1f}", "steps per second": f"{1e3 / wall:.1f}"}
        rows.append(row | {"peak, MiB": f"{turns[0]['peak_bytes'] / 2**20:.0f}"})
    print(table(rows), "\n")


def main(words: Sequence[str] | None = None) -> None:
    """Read the command line and print the tables."""
    parser = parser_of(__doc__)
    parser.add_argument(
        "--sizes", nargs="+", type=positive, default=[112, 256, 512], help="pixels of an edge"
    )
    parser.add_argument("--threads", nargs="+", type=positive, default=[1, 2], help="threads of the steps")
    parser.add_argument("--steps", type=positive, default=30, help="steps of each pass")
    parser.add_argument("--repeats", type=positive, default=5, help="turns of each row of hits")
    parser.add_argument("--turns", type=positive, default=2, help="turns of the steps")
    args = parser.parse_args(words)
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        path = write_tessellated(Path(folder), *LOADED)
        before = peak_bytes()
        seconds = milliseconds(partial(read, path), CPU) / 1e3
        mesh = read(path)
        mebibytes = path.stat().st_size / 2**20
        print(f"{len(mesh.faces):,} triangles ({mebibytes:.0f} MiB) are read in {seconds:.2f} s of CPU time")
        print(
            f"with their normals, and memory grows by {(peak_bytes() - before) / 2**20:.0f} MiB meanwhile.\n"
        )
        compare_hits(Path(folder), args)
        compare_steps(write_tessellated(Path(folder), *STEPS), args)


if __name__ == "__main__":
    main()
