"""Paint the open borders of a mesh: refine it there, so that the paint ends in a clean line, and colour the band."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, UInt8
from scipy import sparse
from scipy.spatial import KDTree

from capture4d.geometry.mesh import boundary_loops, unique_edges
from capture4d.types import Mesh

__all__ = ["PaintedSheet", "paint_borders"]


@dataclass(frozen=True, slots=True, eq=False)
class PaintedSheet:
    """A mesh refined near its borders, as a linear function of the vertices of the mesh it was made from."""

    refine: sparse.csr_array
    """(V', V): vertices of the refined mesh from those of the original; every row is a point of a face."""
    faces: Int32[np.ndarray, "faces 3"]
    colours: UInt8[np.ndarray, "refined 3"]
    painted: Bool[np.ndarray, " refined"]
    """Vertices in a painted band."""
    loops: tuple[Int32[np.ndarray, " _"], ...]
    """Border loops of the original mesh, the longest first."""

    def posed(self, vertices: Float32[np.ndarray, "verts 3"]) -> Mesh:
        """The refined mesh where the original's vertices are at `vertices`."""
        return Mesh((self.refine @ vertices).astype(np.float32), self.faces)


def paint_borders(
    mesh: Mesh,
    *,
    width_m: float,
    garment_colour: tuple[int, int, int],
    border_colours: Sequence[tuple[int, int, int]],
    max_edge_m: float,
) -> PaintedSheet:
    """Paint a band of `width_m` along every border loop; colours serve the loops, the longest first, in turn.

    The paint belongs to the material: measure it once, on the mesh at rest, and reuse the result for every pose. A
    width of 0 or no colours leave the mesh as it is.
    """
    loops = tuple(boundary_loops(mesh.faces))
    refine = sparse.eye_array(len(mesh.vertices), format="csr").astype(np.float32)
    faces, vertices = mesh.faces, mesh.vertices.astype(float)
    has_paint = width_m > 0 and bool(border_colours) and bool(loops)
    while has_paint:
        lengths = np.linalg.norm(vertices[faces] - vertices[np.roll(faces, 1, axis=1)], axis=2).max(axis=1)
        distance = _distance_to_loops(mesh, loops, vertices).min(axis=1)
        chosen = (lengths > max_edge_m) & (distance[faces].min(axis=1) < width_m + lengths)
        if not chosen.any():
            break
        midpoints, faces = _subdivide(faces, chosen, len(vertices))
        refine = sparse.vstack([refine, midpoints @ refine], format="csr")
        vertices = refine @ mesh.vertices.astype(float)
    colours = np.tile(np.array(garment_colour, np.uint8), (len(vertices), 1))
    painted = np.zeros(len(vertices), bool)
    if has_paint:
        distance = _distance_to_loops(mesh, loops, vertices)
        for index in range(len(loops)):
            band = (distance[:, index] <= width_m) & (distance.argmin(axis=1) == index)
            band = _connected_to(faces, band, distance[:, index] < 1e-9)
            colours[band] = border_colours[index % len(border_colours)]
            painted |= band
    return PaintedSheet(sparse.csr_array(refine), faces, colours, painted, loops)


def _distance_to_loops(
    mesh: Mesh, loops: Sequence[np.ndarray], vertices: Float[np.ndarray, "points 3"]
) -> Float[np.ndarray, "points loops"]:
    """Distance of points to each border loop, from samples of its segments; exactly 0 on the loop's own vertices."""
    columns = []
    for loop in loops:
        start, end = mesh.vertices[loop].astype(float), mesh.vertices[np.roll(loop, -1)].astype(float)
        share = np.arange(16)[:, None, None] / 16
        columns.append(KDTree((start + share * (end - start)).reshape(-1, 3)).query(vertices)[0])
        columns[-1][loop] = 0.0
    return np.column_stack(columns)


def _subdivide(
    faces: Int32[np.ndarray, "faces 3"], chosen: np.ndarray, count: int
) -> tuple[sparse.csr_array, Int32[np.ndarray, "more 3"]]:
    """Split the chosen faces in four; their unchosen neighbours keep their edge, on which the new vertices lie."""
    split = faces[chosen]
    edges = unique_edges(split)
    number = dict(zip(map(tuple, edges.tolist()), range(count, count + len(edges)), strict=True))
    new = np.array([[number[min(a, b), max(a, b)] for a, b in ((x, y), (y, z), (z, x))] for x, y, z in split.tolist()])
    (x, y, z), (a, b, c) = split.T, new.T
    quarters = [np.stack(corners, axis=1) for corners in ((x, a, c), (a, y, b), (c, b, z), (a, b, c))]
    rows = np.repeat(np.arange(len(edges)), 2)
    halves = sparse.csr_array(
        (np.full(2 * len(edges), 0.5, np.float32), (rows, edges.ravel())), shape=(len(edges), count)
    )
    return halves, np.concatenate([faces[~chosen], *quarters]).astype(np.int32)


def _connected_to(faces: np.ndarray, band: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """The vertices of `band` that faces within it link to a seed: cloth that only hangs close by stays unpainted."""
    inside = faces[band[faces].all(axis=1)]
    links = (np.ones(2 * len(inside), bool), (inside[:, :2].T.ravel(), inside[:, 1:].T.ravel()))
    graph = sparse.coo_array(links, shape=(len(band),) * 2)
    _, part = sparse.csgraph.connected_components(graph, directed=False)
    return band & np.isin(part, part[seeds & band])
