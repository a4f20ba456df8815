"""A garment mesh shrunk onto the body it lies on, along a cage: which body point each of its vertices belongs to.

The cage is given, or found: where the panels of kept UVs meet, and in loops around the body where cloth that one joint
carries meets that of the next, as chest, waist, hips and arms would be marked by hand. On the body the cage lies where
its vertices have their nearest points that face the same way, evened out along its curves.

References: Jin et al., A pixel-based framework for data-driven clothing, SCA 2020, appendices C and D.5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int32

from capture4d.body.posed_surface import PosedSurface, match
from capture4d.errors import InputError
from capture4d.geometry.cages.cage import Cage, cage_of_curves, cage_of_labels, merged_specks
from capture4d.geometry.cages.dirichlet import Extension, dirichlet_form
from capture4d.geometry.cages.shrink_wrap import (
    OnSurface,
    edge_ratio_spread,
    equalise,
    flipped_faces,
    morph,
    on_surface,
    push_out,
    turned_in_faces,
)
from capture4d.geometry.mesh import face_areas, flat_edge_lengths, unique_edges
from capture4d.geometry.ray_casting import TriangleScene
from capture4d.geometry.tangents import TangentLayout
from capture4d.types import Mesh

__all__ = ["ITERATIONS", "CageMarks", "Wrap", "found_cage", "wrap_garment"]

ITERATIONS = 200
"""Of the springs at most."""
CAGE_SMOOTHING = 6
"""Steps along the cage: nearest points of neighbours jump at creases of the body."""
SMALLEST_PATCH = 0.01
"""Share of the garment below which what one joint carries is no patch."""
ALONG, THROUGH_M = (0.25, 0.5, 0.75), 0.005
"""Where on the way to a match it is looked for whether it leads through the body, and how deep that is."""


@dataclass(frozen=True, slots=True, eq=False)
class CageMarks:
    """A cage as it is marked on a mesh file: labels of its triangles or curves through its vertices."""

    labels: Int32[np.ndarray, " faces"] | None = None
    curves: tuple[Int32[np.ndarray, " _"], ...] = ()
    source: str = "cage"
    """What errors call it."""

    def on(self, mesh: Mesh, of_vertex: Int32[np.ndarray, " file_verts"]) -> Cage:
        """The cage on the mesh whose seams are joined.

        Args:
            of_vertex: what each vertex of the file became.
        Raises:
            InputError: labels for another number of triangles, or curves through vertices that are not there.
        """
        strange = [int(curve.max()) for curve in self.curves if curve.max(initial=0) >= len(of_vertex)]
        if strange:
            raise InputError(f"expected vertices from 0 to {len(of_vertex) - 1}, found {strange[0]}", where=self.source)
        try:
            if self.labels is not None:
                return cage_of_labels(mesh.faces, self.labels)
            return cage_of_curves(mesh.vertices, mesh.faces, [of_vertex[curve] for curve in self.curves])
        except InputError as error:
            raise error.at(self.source) from None


@dataclass(frozen=True, slots=True, eq=False)
class Wrap:
    """Where a garment lies shrunk onto the body, and how well."""

    placed: OnSurface
    pushed_out: OnSurface
    """After the second step, on the surface: what the third began from."""
    cage: Cage
    spread_before: float
    """Of the edges' ratios to their rest lengths, standard deviation over mean, of `pushed_out`."""
    spread: float
    """The same in the end."""
    flipped_percent: float
    """Faces that look the other way than most do, on the body."""
    turned_in_percent: float
    """Those of them that did before the garment was shrunk, in turned-in hems and collars."""


def found_cage(
    mesh: Mesh, skin_weights: Float[np.ndarray, "verts joints"], uv: Float[np.ndarray, "faces 3 2"] | None
) -> Cage:
    """A cage for a garment of which nothing is marked.

    Args:
        skin_weights: of the garment, smooth.
        uv: whose islands are panels; None without.
    """
    joints = skin_weights[mesh.faces].sum(axis=1).argmax(axis=1)
    panels = np.zeros(len(mesh.faces), np.int64) if uv is None else TangentLayout(mesh.faces, uv).islands()
    labels = panels * skin_weights.shape[1] + joints
    areas = face_areas(mesh.vertices.astype(np.float64), mesh.faces)
    return cage_of_labels(mesh.faces, merged_specks(mesh.faces, labels, areas, SMALLEST_PATCH))


def wrap_garment(
    mesh: Mesh,
    surface: PosedSurface,
    normals: Float64[np.ndarray, "verts 3"],
    nearest: Float64[np.ndarray, "verts 3"],
    *,
    cage: Cage,
    flat: Float64[np.ndarray, "faces 3 2"],
    iterations: int = ITERATIONS,
) -> Wrap:
    """Shrink a garment onto the posed body in the paper's three steps.

    Args:
        mesh: metres, on the body.
        surface: the body in the pose in which it lies there.
        normals: of the mesh, turned the way the body faces; their length is their weight in the match.
        nearest: body point of each vertex, from a match with these normals.
        flat: the faces at rest in the plane, metres: the sewing pattern, or the mesh's own.
        iterations: of the third step at most.
    Raises:
        InputError: a part of the mesh has neither cage nor border.
    """
    vertices, faces = mesh.vertices.astype(np.float64), mesh.faces
    extension = Extension(dirichlet_form(faces, flat, len(vertices)), cage.vertices)
    scene = TriangleScene((surface.vertices, surface.model.body.template.faces))
    start, facing = vertices[cage.vertices], np.ascontiguousarray(normals[cage.vertices])
    there = start + cage.smoothed(_reached(scene, start, nearest[cage.vertices]) - start, CAGE_SMOOTHING)
    targets = _reached(scene, there, match(surface, there, facing).points)
    pushed = on_surface(scene, push_out(scene, morph(vertices, extension, targets)))
    rest = flat_edge_lengths(flat, faces, unique_edges(faces))
    turned_in = turned_in_faces(scene, vertices, faces)
    placed = equalise(scene, pushed.points, faces, rest, turned_in=turned_in, iterations=iterations)
    flipped = flipped_faces(placed, faces)
    return Wrap(
        placed,
        pushed,
        cage,
        edge_ratio_spread(pushed.points, faces, rest),
        edge_ratio_spread(placed.points, faces, rest),
        100.0 * float(flipped.mean()),
        100.0 * float((flipped & turned_in).mean()),
    )


def _reached(
    scene: TriangleScene, points: Float64[np.ndarray, "C 3"], matched: Float64[np.ndarray, "C 3"]
) -> Float64[np.ndarray, "C 3"]:
    """The matched body points, but the nearest ones where the way to the match leads through the body: cloth that is
    turned in, as a hem's or a collar's lower layer, faces the far side of the limb it lies on.
    """
    ways = points + np.array(ALONG)[:, None, None] * (matched - points)
    depths = scene.signed_distances(ways.reshape(-1, 3)).reshape(len(ALONG), -1).min(axis=0)
    blocked = depths < np.minimum(scene.signed_distances(points), 0.0) - THROUGH_M
    return np.where(blocked[:, None], scene.nearest(points).points, matched)
