"""What registration needs to know about a template, found once and used for every frame."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int32

from capture4d.body.sewing_pattern import rest_lengths, with_known_pattern
from capture4d.captures.names import unknown_borders
from capture4d.errors import InputError
from capture4d.geometry.mesh import doubled_area_vectors, edge_uses, normalised, unique_edges
from capture4d.types import Garment
from registration.cloth_colours import ClothColours
from registration.config import RegistrationConfig
from registration.deformation_graph import DeformationGraph, build_graph
from registration.fold_lengths import edge_faces
from registration.solver import Rows

__all__ = ["Border", "TemplateAnalysis", "UnknownBorderError", "analyse_template", "fold_cosines", "require_borders"]


@dataclass(frozen=True, slots=True, eq=False)
class Border:
    """All border loops of a template, one after the other."""

    vertices: Int32[np.ndarray, " border"]
    before: Int32[np.ndarray, " border"]
    """The vertex before each along its loop."""
    after: Int32[np.ndarray, " border"]
    loops: Int32[np.ndarray, " border"]
    """Index into `names`."""
    names: tuple[str, ...]

    def tangents(self, positions: Float64[np.ndarray, "verts 3"]) -> Float64[np.ndarray, "border 3"]:
        """Unit directions along the border."""
        along = positions[self.after] - positions[self.before]
        return along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)


@dataclass(frozen=True, slots=True, eq=False)
class TemplateAnalysis:
    """Sparsity and weights of one template: many frames share it."""

    garment: Garment
    faces: Int32[np.ndarray, "faces 3"]
    rest: Float64[np.ndarray, "verts 3"]
    edges: Int32[np.ndarray, "edges 2"]
    edge_faces: Int32[np.ndarray, "edges 2"]
    """The faces on both sides of each edge; on the border the one face twice."""
    rest_lengths: Float64[np.ndarray, " edges"]
    rest_folds: Float64[np.ndarray, " edges"]
    """`fold_cosines` at rest."""
    graph: DeformationGraph
    coarse_vertices: Int32[np.ndarray, " subset"]
    """Vertices that carry the coarse data term; border vertices are among them."""
    border: Border
    vertex_rows: Rows
    """Vertices as they are."""
    fan_offsets: Int32[np.ndarray, " verts_plus_1"]
    fan_faces: Int32[np.ndarray, " corners"]
    """Faces around vertex v: fan_faces[fan_offsets[v] : fan_offsets[v + 1]]."""
    laplacian_rows: Rows
    """Each vertex minus the mean of its neighbours; along the border, of its neighbours on the border."""
    laplacian_columns: Rows
    """The same, transposed."""
    cloth: tuple[ClothColours, ...] = ()
    """Its colours, the most blurred first; none where those of the scans do not take part."""


def analyse_template(garment: Garment, config: RegistrationConfig) -> TemplateAnalysis:
    """Deformation graph, coarse vertices, borders and difference operators of a template.

    Raises:
        InputError: the template has no faces.
    """
    faces = garment.template.faces
    if not len(faces):
        raise InputError("template: expected at least one face, found none")
    rest = garment.template.vertices.astype(np.float64)
    graph = build_graph(rest, faces, nodes=config.graph.nodes, nodes_per_vertex=config.graph.nodes_per_vertex)
    border = _border(garment)
    edges = unique_edges(faces)
    sides, differences = edge_faces(faces, edges), _laplacian_rows(edges, faces, len(rest))
    lengths = rest_lengths(with_known_pattern(garment), edges)
    corners_per_vertex = np.bincount(faces.reshape(-1), minlength=len(rest))
    return TemplateAnalysis(
        garment=garment,
        faces=faces,
        rest=rest,
        edges=edges,
        edge_faces=sides,
        rest_lengths=lengths,
        rest_folds=fold_cosines(rest, faces, sides),
        graph=graph,
        coarse_vertices=_coarse_vertices(len(rest), config.graph.vertices, border, faces),
        border=border,
        vertex_rows=Rows.of_points(np.arange(len(rest))),
        fan_offsets=np.concatenate([[0], np.cumsum(corners_per_vertex)]).astype(np.int32),
        fan_faces=(np.argsort(faces.reshape(-1), kind="stable") // 3).astype(np.int32),
        laplacian_rows=differences,
        laplacian_columns=differences.transposed(len(rest)),
    )


def fold_cosines(
    positions: Float64[np.ndarray, "verts 3"],
    faces: Int32[np.ndarray, "faces 3"],
    sides: Int32[np.ndarray, "edges 2"],
) -> Float64[np.ndarray, " edges"]:
    """Cosine between the normals of the faces on both sides of each edge, which are given by `sides`."""
    normals = normalised(doubled_area_vectors(positions, faces))
    return np.einsum("ea,ea->e", normals[sides[:, 0]], normals[sides[:, 1]])


class UnknownBorderError(InputError):
    """Paints are named after loops that the template lacks: no frame of the take can be registered."""


def require_borders(border: Border, painted: Iterable[str]) -> None:
    """See that the template has every border that a paint is named after; such as are called `border` are on any.

    Raises:
        UnknownBorderError: it has not; the message names both lists.
    """
    missing = unknown_borders(painted, border.names)
    if missing:
        found = f"those named {', '.join(border.names)}" if border.names else "none"
        raise UnknownBorderError(
            f"template: expected border loops named {', '.join(missing)}, as the paints are; found {found}"
        )


def _border(garment: Garment) -> Border:
    names = tuple(garment.loops)
    loops = list(garment.loops.values())
    empty = np.zeros(0, np.int32)
    return Border(
        vertices=np.concatenate([empty, *loops]),
        before=np.concatenate([empty, *(np.roll(loop, 1) for loop in loops)]),
        after=np.concatenate([empty, *(np.roll(loop, -1) for loop in loops)]),
        loops=np.concatenate([empty, *(np.full(len(loop), i, np.int32) for i, loop in enumerate(loops))]),
        names=names,
    )


def _coarse_vertices(count: int, wanted: int, border: Border, faces: np.ndarray) -> np.ndarray:
    """A fixed random subset of the vertices in use, and all border vertices."""
    used = np.unique(faces)
    if 0 < wanted < len(used):
        used = np.random.default_rng(0).choice(used, wanted, replace=False)
    return np.union1d(used, border.vertices).astype(np.int32)


def _laplacian_rows(edges: np.ndarray, faces: np.ndarray, count: int) -> Rows:
    on_border = edge_uses(faces)[1] == 1
    border_vertex = np.zeros(count, bool)
    border_vertex[edges[on_border].reshape(-1)] = True
    both = np.concatenate([edges, edges[:, ::-1]])
    on_border = np.concatenate([on_border, on_border])
    both = both[~border_vertex[both[:, 0]] | on_border]
    both = both[np.lexsort((both[:, 1], both[:, 0]))]
    degree = np.bincount(both[:, 0], minlength=count)
    offsets = np.concatenate([[0], np.cumsum(degree + (degree > 0))]).astype(np.int32)
    columns = np.empty(offsets[-1], np.int32)
    coefficients = np.empty((offsets[-1], 1))
    own = offsets[:-1][degree > 0]
    columns[own], coefficients[own] = np.flatnonzero(degree > 0), 1.0
    others = np.ones(offsets[-1], bool)
    others[own] = False
    columns[others] = both[:, 1]
    coefficients[others, 0] = -1.0 / degree[both[:, 0]]
    return Rows(offsets, columns, coefficients)
