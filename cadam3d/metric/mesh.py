"""MeshMetric: how close the surface of an asset is to the true surface, if that is known."""

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np
from jaxtyping import Float, Int

from cadam3d.core.checks import whole, within
from cadam3d.core.mesh.surface import SurfaceSettings, areas
from cadam3d.core.number import Number
from cadam3d.core.rendering import Triangles
from cadam3d.metric.base import Measurand, Measurement, Metric

# Samples of a surface that lead to the triangles near a point.
GUIDES = 200_000
NEIGHBOURS = 8

FSCORE = Number(
    name="mesh_fscore", label="F-score of the mesh", digits=3, is_more_better=True, needs_truth=True
)


@dataclass(frozen=True, kw_only=True)
class MeshMetric(SurfaceSettings, Metric):
    """Chamfer distance and F-score between the mesh of an asset and the true surface.

    Both surfaces are the parts that can be reached from outside. ``samples`` points are drawn on each,
    uniformly by area, and their distances to the other surface are exact distances to its triangles. With the
    distances ``a`` of the samples of the mesh and the distances ``b`` of the samples of the true surface:

    * ``mesh_chamfer = (mean(a) + mean(b)) / 2``, in world units,
    * ``mesh_precision`` and ``mesh_recall`` are the shares of ``a`` and of ``b`` that are at most
      ``threshold``,
    * ``mesh_fscore = 2 precision recall / (precision + recall)``, and 0 if both are 0 (Knapitsch et al.
      2017).

    If the modes of a truth have different shapes, the one with the smallest Chamfer distance counts. If the
    asset may face any side, the true surface faces as the asset does (``turn_deg``).
    """

    node: ClassVar[str] = "metric.mesh"
    numbers: ClassVar[tuple[Number, ...]] = (
        Number(
            name="mesh_chamfer",
            label="Chamfer distance of the mesh",
            unit="world units",
            digits=4,
            is_more_better=False,
            needs_truth=True,
        ),
        FSCORE,
        replace(FSCORE, name="mesh_precision", label="precision of the mesh"),
        replace(FSCORE, name="mesh_recall", label="recall of the mesh"),
    )

    threshold: Annotated[float, within(above=0, high=10)]  # world units
    samples: Annotated[int, whole(low=100, high=10_000_000)]
    seed: Annotated[int, whole(low=0, high=2**62)]

    def measure(self, measurand: Measurand) -> Measurement:
        """Return the four numbers of the class; nothing if the true shape is not known.

        Raises ``UserError`` if the asset has no surface.
        """
        true = measurand.truth and measurand.truth.turned()
        if true is None or true.surfaces is None:
            return Measurement({})
        surface, _ = self.surface(measurand.gaussians)
        results = []
        for vertices, faces in true.surfaces():
            to_true, to_mesh = distances_between(
                (surface.vertices, surface.faces), (vertices, faces), self.samples, self.seed
            )
            chamfer = float((to_true.mean() + to_mesh.mean()) / 2)
            results.append((chamfer, *f_score(to_true, to_mesh, self.threshold)))
        names = [number.name for number in self.numbers]
        return Measurement(dict(zip(names, min(results), strict=True)))


def f_score(
    to_true: Float[np.ndarray, "a"], to_mesh: Float[np.ndarray, "b"], threshold: float
) -> tuple[float, float, float]:
    """Return F-score, precision and recall for the distances of both directions (see :class:`MeshMetric`)."""
    precision, recall = float((to_true <= threshold).mean()), float((to_mesh <= threshold).mean())
    total = precision + recall
    return (2 * precision * recall / total if total > 0 else 0.0), precision, recall


def distances_between(
    ours: Triangles, theirs: Triangles, samples: int, seed: int
) -> tuple[Float[np.ndarray, "samples"], Float[np.ndarray, "samples"]]:
    """Return the distances of random points of ``ours`` to ``theirs``, and of ``theirs`` to ``ours``."""
    draw = np.random.default_rng(seed)
    (our_points, our_faces), (their_points, their_faces) = (
        _sample(mesh, max(GUIDES, samples), draw) for mesh in (ours, theirs)
    )
    return (
        _distances(our_points[:samples], theirs, their_points, their_faces),
        _distances(their_points[:samples], ours, our_points, our_faces),
    )


def _sample(
    mesh: Triangles, count: int, draw: np.random.Generator
) -> tuple[Float[np.ndarray, "count 3"], Int[np.ndarray, "count"]]:
    """Return random points of a mesh, uniform by area, and the triangle of each."""
    vertices, faces = mesh
    ends = areas(vertices, faces).cumsum()
    face = np.searchsorted(ends, draw.random(count) * ends[-1], side="right").clip(max=len(faces) - 1)
    # The square root makes the density uniform (Turk 1990).
    root, share = np.sqrt(draw.random((count, 1))), draw.random((count, 1))
    a, b, c = (vertices[faces[face, corner]] for corner in range(3))
    return (1 - root) * a + root * (1 - share) * b + root * share * c, face


def _distances(
    points: Float[np.ndarray, "p 3"],
    mesh: Triangles,
    guides: Float[np.ndarray, "g 3"],
    guide_faces: Int[np.ndarray, "g"],
) -> Float[np.ndarray, "p"]:
    """Return the distances of points to a mesh, whose sampled points find the triangles near each."""
    from scipy.spatial import KDTree  # both are slow to import
    from trimesh.triangles import closest_point

    vertices, faces = mesh
    _, nearest = KDTree(guides).query(points, k=NEIGHBOURS)
    best = np.full(len(points), np.inf)
    for column in guide_faces[nearest].T:
        away = points - closest_point(vertices[faces[column]], points)
        np.minimum(best, np.linalg.norm(away, axis=1), out=best)
    return best
