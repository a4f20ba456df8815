"""Fine folds on a coarse cloth: lift a dense mesh onto the coarse sheet and relax it at its true rest lengths.

The coarse sheet was simulated on a shrunk pattern, so the lifted dense mesh is compressed. Relaxation lets it buckle:
isometric bending, a foundation that holds it to the sheet (weakly along the normal), the body as half planes, and
inextensible edges. The folds start from one fixed imperfection of the cloth blended with the folds of the frame
before, so they follow the pose and hardly the history.

Letters: V fine vertices, C coarse vertices, E edges, Q inner edges (hinges). Metres, world frame.

References: isometric bending, Bergou et al., A Quadratic Bending Model for Inextensible Surfaces (SGP 2006); the
position-based projections, Mueller et al. (2007); wrinkle meshes, Mueller and Chentanez (SCA 2010); Phong tessellation,
Boubekeur and Alexa (2008).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from capture4d.body.skinning import PosedBody
from capture4d.geometry.mesh import vertex_adjacency, vertex_normals
from capture4d.geometry.ray_casting import TriangleScene, barycentric
from data_synth.cloth.fabrics import Fabric
from data_synth.cloth.patterns import PanelMesh, locate, smooth_noise
from data_synth.cloth.stencils import hinges, rest_lengths
from data_synth.cloth.tailoring import Made, Sleeve, Wall, bending_factors, shrunk, wall_heights, walls
from data_synth.cloth.tightening import flatten, lengthen, tighten
from data_synth.cloth.untangling import Room, untangle
from data_synth.config import RelaxationConfig

__all__ = [
    "BodyPlanes",
    "BodySurface",
    "Finish",
    "Level",
    "WrinkleMesh",
    "lift_levels",
    "relax_frame",
    "relax_levels",
    "wrinkle_mesh",
]

FOLD_ROOM_M = 0.015
"""Cloth as near to the plane between arm and trunk stays on its side of it."""
RAISED_RINGS, RAISED_SWEEPS = 3, 20
"""So many rings around a turned layer give way to its thickness, in as many sweeps."""


@dataclass(frozen=True, slots=True, eq=False)
class WrinkleMesh:
    """All that relaxation needs and that no frame changes."""

    faces: np.ndarray
    """(F, 3) int32 of the fine mesh."""
    coarse_faces: np.ndarray
    """(G, 3) int32 of the coarse mesh."""
    lift_vertices: np.ndarray
    """(V, 3) coarse vertices around each fine vertex."""
    lift_weights: np.ndarray
    """(V, 3) their barycentric weights."""
    tangent_edges: np.ndarray
    """(V, 2) a fine edge from each vertex, whose direction carries offsets from frame to frame."""
    edges: np.ndarray
    """(E, 2) int32."""
    rest_lengths: np.ndarray
    """(E,) float32, metres on the pattern."""
    hinges: np.ndarray
    """(Q, 4) int32: the ends of an inner edge, then the vertices opposite."""
    hinge_weights: np.ndarray
    """(Q, 5) float32: the bending stencil, and one over its squared norm."""
    imperfection: np.ndarray
    """(V,) float32 offset along the normal from which folds start, metres."""
    sleeves: tuple[Sleeve, ...] = ()
    """What must not pass through each other."""
    raised: np.ndarray | None = None
    """(V,) how far a turned layer stands out, metres."""


@dataclass(frozen=True, slots=True, eq=False)
class Finish:
    """What a frame's folds end with: sweeps over nearly unbent cloth, and steps that part what cuts itself."""

    sweeps: int
    bending: float
    over_relaxation: float
    slack: float = 1.0
    untangle_steps: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """Folds of one width: a mesh over the level before, or over the simulated sheet, and how it is relaxed."""

    mesh: WrinkleMesh
    fabric: Fabric
    config: RelaxationConfig
    finish: Finish | None = None


@dataclass(frozen=True, slots=True, eq=False)
class BodyPlanes:
    """The body near each fine vertex, as a half plane."""

    points: np.ndarray
    """(V, 3) nearest body points."""
    normals: np.ndarray
    """(V, 3) smooth body normals there."""


def wrinkle_mesh(
    coarse: PanelMesh,
    fine: PanelMesh,
    config: RelaxationConfig,
    rng: np.random.Generator,
    *,
    fabric: Fabric | None = None,
    made: Made | None = None,
    excess_left: float = 0.0,
) -> WrinkleMesh:
    """Precompute the stencils of a fine mesh over a coarse one of the same pattern.

    Args:
        rng: draws the imperfection; one seed is one garment.
        fabric: what of, and made: how the garment was made, on the fine mesh; alike everywhere where None.
        excess_left: share of its excess cloth that is left to the next level.
    """
    lift_faces, lift_weights = locate(coarse, fine.vertex_uv)
    edges, lengths = rest_lengths(fine if made is None else shrunk(fine, made.tailoring.scale, excess_left))
    stencils, weights = hinges(fine)
    if made is not None and fabric is not None:
        # A projection of the whole bend is all that a sweep can do.
        factors = np.minimum(bending_factors(fine, made, fabric, stencils[:, :2]), 1 / max(fabric.fold_bending, 1e-6))
        weights[:, 4] *= factors
    adjacency = vertex_adjacency(fine.faces, fine.vertex_count)
    neighbour = adjacency.indices[adjacency.indptr[:-1]]
    return WrinkleMesh(
        faces=fine.faces,
        coarse_faces=coarse.faces,
        lift_vertices=coarse.faces[lift_faces],
        lift_weights=lift_weights,
        tangent_edges=np.stack([np.arange(fine.vertex_count), neighbour], axis=1),
        edges=edges.astype(np.int32),
        rest_lengths=lengths.astype(np.float32),
        hinges=stencils.astype(np.int32),
        hinge_weights=weights.astype(np.float32),
        imperfection=smooth_noise(fine.noise_uv, config.imperfection_m, config.imperfection_width_m, rng),
        sleeves=() if made is None else made.tailoring.sleeves,
        raised=None if made is None else np.where(made.tailoring.strip, made.folds.strip_thickness_m, 0.0),
    )


def lift(mesh: WrinkleMesh, coarse: np.ndarray, smoothing: float = 0.6) -> tuple[np.ndarray, np.ndarray]:
    """Place the fine mesh on a coarse frame by Phong tessellation.

    Returns:
        Positions and unit normals, both (V, 3) float64.
    """
    normals = vertex_normals(coarse, mesh.coarse_faces)[mesh.lift_vertices]
    corners, weights = coarse[mesh.lift_vertices], mesh.lift_weights[..., None]
    flat = (corners * weights).sum(axis=1)
    projected = flat[:, None] - ((flat[:, None] - corners) * normals).sum(axis=2, keepdims=True) * normals
    curved = (1 - smoothing) * flat + smoothing * (projected * weights).sum(axis=1)
    normal = (normals * weights).sum(axis=1)
    return curved, normal / np.linalg.norm(normal, axis=1, keepdims=True)


@dataclass(frozen=True, slots=True, eq=False)
class BodySurface:
    """A posed body that is looked up several times."""

    scene: TriangleScene
    faces: np.ndarray
    normals: np.ndarray

    @staticmethod
    def create(surface: np.ndarray, faces: np.ndarray) -> BodySurface:
        return BodySurface(TriangleScene((surface, faces)), faces, vertex_normals(surface, faces))

    def planes(self, points: np.ndarray) -> BodyPlanes:
        nearest = self.scene.nearest(points)
        normals = np.einsum("vk,vkc->vc", barycentric(nearest.uv), self.normals[self.faces[nearest.faces]])
        return BodyPlanes(nearest.points, normals / np.linalg.norm(normals, axis=1, keepdims=True))


def _may_touch(mesh: WrinkleMesh, coarse: np.ndarray, base: np.ndarray, body: BodySurface, reach: float) -> np.ndarray:
    """Which fine vertices may lie within `reach` of the body, (n,); four in ten do not, and are not looked up.

    A vertex is no nearer to the body than a coarse vertex beside it less the way between them.
    """
    planes = body.planes(coarse)
    away = coarse - planes.points
    outside = np.einsum("vc,vc->v", away, planes.normals) > 0
    distance = np.where(outside, np.linalg.norm(away, axis=1), 0)[mesh.lift_vertices]
    way = np.linalg.norm(base[:, None] - coarse[mesh.lift_vertices], axis=2)
    return np.flatnonzero((distance - way).max(axis=1) < reach)


def relax_levels(
    levels: Sequence[Level], coarse: np.ndarray, body: PosedBody, previous: Sequence[np.ndarray] | None
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Fold one coarse frame, (C, 3), level by level, the widest folds first.

    Args:
        previous: what the call for the frame before returned; None to start anew.
    Returns:
        Vertices of the last level, (V, 3) float32, and the offsets of each, as `relax_frame` returns them.
    """
    surface = BodySurface.create(body.vertices(), body.shaped.body.template.faces)
    offsets, sheet = [], coarse
    between = walls(levels[0].mesh.sleeves, body)
    for number, level in enumerate(levels):
        sheet, offset = relax_frame(level, sheet, surface, None if previous is None else previous[number], between)
        offsets.append(offset)
    return _raised(levels[-1].mesh, sheet, 1.0 if levels[-1].finish is None else levels[-1].finish.slack), offsets


def _raised(mesh: WrinkleMesh, sheet: np.ndarray, slack: float) -> np.ndarray:
    """The sheet, (V, 3), with its turned layers standing out, at its own lengths."""
    if mesh.raised is None:
        return sheet
    outwards = vertex_normals(sheet.astype(np.float64), mesh.faces)
    sheet = (sheet + mesh.raised[:, None] * outwards).astype(np.float32)
    near = mesh.raised > 0
    for _ in range(RAISED_RINGS):
        near[mesh.edges[near[mesh.edges].any(axis=1)]] = True
    inner = near[mesh.edges].all(axis=1)
    edges, lengths = mesh.edges[inner], mesh.rest_lengths[inner]
    for sweep in range(RAISED_SWEEPS):
        lengthen(sheet, edges, lengths, np.float32(0.5), np.float32(slack), sweep % 2 == 0)
    return sheet


def lift_levels(levels: Sequence[Level], coarse: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Place the finest mesh on a coarse frame without any folds; positions and normals, as `lift` returns them."""
    for level in levels[:-1]:
        coarse, _ = lift(level.mesh, coarse)
    return lift(levels[-1].mesh, coarse)


def relax_frame(
    level: Level,
    coarse: np.ndarray,
    body: BodySurface,
    previous_offsets: np.ndarray | None,
    between: Sequence[Wall] = (),
) -> tuple[np.ndarray, np.ndarray]:
    """Fold the mesh of a level over one coarse frame.

    Args:
        coarse: (C, 3) coarse cloth.
        body: surface of the same frame.
        previous_offsets: what the call for the frame before returned; None to start anew, with more sweeps.
        between: the planes beside the mesh's sleeves.
    Returns:
        Fine vertices (V, 3) float32, and their offsets from the lifted sheet in material frames, (V, 3) float32.
    """
    mesh, config = level.mesh, level.config
    base, normals = lift(mesh, coarse)
    frames = _material_frames(mesh, base, normals)
    offsets = np.zeros((len(base), 3))
    offsets[:, 2] = mesh.imperfection
    sweeps = config.sweeps
    if previous_offsets is None:
        sweeps *= config.start_sweeps_factor
    else:
        offsets = config.warm_start * previous_offsets + (1 - config.warm_start) * offsets
    points = (base + np.einsum("vji,vj->vi", frames, offsets)).astype(np.float32)
    near = _may_touch(mesh, coarse, base, body, config.radius_m + 2 * config.body_margin_m)
    plane_points, plane_normals = (base - normals).astype(np.float32), normals.astype(np.float32)  # out of the way
    for planes_at in (base, points):  # the body is a half plane per vertex, so it is looked up again half-way
        planes = body.planes(planes_at[near])
        plane_points[near], plane_normals[near] = planes.points, planes.normals
        _stand_walls(mesh.sleeves, between, planes_at, plane_points, plane_normals)
        _relax(
            points,
            base.astype(np.float32),
            normals.astype(np.float32),
            mesh.edges,
            mesh.rest_lengths,
            mesh.hinges,
            mesh.hinge_weights,
            np.float32(level.fabric.fold_bending),
            np.float32(config.pull_normal),
            np.float32(config.pull_tangential),
            np.float32(config.radius_m),
            plane_points,
            plane_normals,
            np.float32(config.body_margin_m),
            (sweeps + 1) // 2,
        )
    if level.finish is not None:
        room = Room(base.astype(np.float32), 1.2 * config.radius_m, plane_points, plane_normals, config.body_margin_m)
        tighten(
            points,
            room.base,
            np.float32(room.radius),
            mesh.edges,
            mesh.rest_lengths,
            np.float32(level.finish.over_relaxation),
            np.float32(level.finish.slack),
            mesh.hinges,
            mesh.hinge_weights,
            np.float32(level.finish.bending),
            plane_points,
            plane_normals,
            np.float32(room.margin),
            level.finish.sweeps,
        )
        points = untangle(points, mesh.faces, mesh.edges, mesh.rest_lengths, room, steps=level.finish.untangle_steps)
    planes = body.planes(points[near])
    depth = np.einsum("vc,vc->v", points[near] - planes.points, planes.normals) - 0.2 * config.body_margin_m
    points[near] -= (np.minimum(depth, 0)[:, None] * planes.normals).astype(np.float32)
    return points, np.einsum("vij,vj->vi", frames, points - base).astype(np.float32)


def _stand_walls(
    sleeves: Sequence[Sleeve],
    between: Sequence[Wall],
    points: np.ndarray,
    plane_points: np.ndarray,
    plane_normals: np.ndarray,
) -> None:
    """Write the wall beside a sleeve over the half plane, (V, 3) each, of every vertex that is nearer to the wall."""
    for sleeve, wall in zip(sleeves, between, strict=True):
        heights, below = wall_heights(points, sleeve, wall)
        over_body = np.einsum("nc,nc->n", points[sleeve.rows] - plane_points[sleeve.rows], plane_normals[sleeve.rows])
        near = (below > 0) & (heights < np.minimum(over_body, FOLD_ROOM_M))
        rows, normals = sleeve.rows[near], sleeve.signs[near, None] * wall.normal
        plane_normals[rows], plane_points[rows] = normals, points[rows] - heights[near, None] * normals


def _material_frames(mesh: WrinkleMesh, base: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(V, 3, 3) rows tangent, bitangent, normal; the tangent follows a fixed edge of the cloth."""
    along = base[mesh.tangent_edges[:, 1]] - base[mesh.tangent_edges[:, 0]]
    along -= (along * normals).sum(axis=1, keepdims=True) * normals
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return np.stack([along, np.cross(normals, along), normals], axis=1)


@njit(cache=True, fastmath=True, nogil=True)
def _relax(
    x,
    base,
    normals,
    edges,
    lengths,
    hinges,
    weights,
    bend,
    pull_n,
    pull_t,
    radius,
    planes,
    plane_normals,
    margin,
    sweeps,
):
    one, half = np.float32(1), np.float32(0.5)
    for sweep in range(sweeps):
        forward = sweep % 2 == 0
        flatten(x, hinges, weights, bend, forward)
        for i in range(len(x)):
            nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
            ox, oy, oz = x[i, 0] - base[i, 0], x[i, 1] - base[i, 1], x[i, 2] - base[i, 2]
            height = ox * nx + oy * ny + oz * nz
            keep, extra = one - pull_t, (pull_t - pull_n) * height
            ox, oy, oz = keep * ox + extra * nx, keep * oy + extra * ny, keep * oz + extra * nz
            size = np.sqrt(ox * ox + oy * oy + oz * oz)
            if size > radius:
                ox, oy, oz = ox * radius / size, oy * radius / size, oz * radius / size
            px, py, pz = base[i, 0] + ox, base[i, 1] + oy, base[i, 2] + oz
            depth = (
                (px - planes[i, 0]) * plane_normals[i, 0]
                + (py - planes[i, 1]) * plane_normals[i, 1]
                + (pz - planes[i, 2]) * plane_normals[i, 2]
                - margin
            )
            if depth < 0:
                px -= depth * plane_normals[i, 0]
                py -= depth * plane_normals[i, 1]
                pz -= depth * plane_normals[i, 2]
            x[i, 0], x[i, 1], x[i, 2] = px, py, pz
        lengthen(x, edges, lengths, half, one, forward)
