"""Cloth at rest on a still body: a small-step solver in one compiled loop.

Every substep predicts, pulls the cloth towards where the garment is held, resolves contact with friction, bends, and
stretches, constraint by constraint, once. Edges come last: contact would leave faces crushed where the body is creased.
Short substeps stand for iterations: the sag of a sheet that is not solved to the end goes with the square of the step,
and at 1/360 s edges around the armholes stay stretched by half.

Left and right are treated alike: a constraint is followed by its mirror image, so that the mirror image of a pose gives
the mirror image of the drape as far as rounding and the constraints across the middle allow.

Letters: V vertices, E edges, Q hinges, C contacts. Metres, seconds, kilograms.

References: Macklin et al., Small Steps in Physics Simulation (SCA 2019), and XPBD (MIG 2016); isometric bending, Bergou
et al., A Quadratic Bending Model for Inextensible Surfaces (SGP 2006).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture4d.heavy_imports import njit
from data_synth.cloth.patterns import PanelMesh
from data_synth.cloth.stencils import hinges, rest_areas, rest_lengths
from data_synth.drapes.config import Cloth

__all__ = ["FRAME_SUBSTEPS", "SUBSTEP_S", "Planes", "Sheet", "advance", "keep_lengths", "push_out"]

SUBSTEP_S = 1 / 1440
FRAME_SUBSTEPS = 24
"""Substeps of a sixtieth of a second, in which motion is told."""
GRAVITY = 9.81
OUTWARDS_M = 0.002
"""A substep pushes a vertex no farther out of the body: what is deep inside comes out in several, and is not thrown."""
AREA_LIMITS = (0.45, 1.6)
"""Shares of its area within which a face ends: a sliver has edges of about their lengths, and no area."""
FARTHEST_M = 0.005
"""Nor does a vertex take a velocity along that would move it farther in the next."""


@dataclass(frozen=True, slots=True, eq=False)
class Sheet:
    """A garment's cloth: what no pose changes."""

    edges: np.ndarray
    """(E, 2) int32."""
    lengths: np.ndarray
    """(E,) at rest, on the pattern."""
    edge_firmness: np.ndarray
    """(E, 3) kilograms: by how much of its excess a stretched edge is corrected in a substep, one beyond the limits,
    and a compressed one, over the inverse mass of each end."""
    strain_limits: tuple[float, float]
    """Beyond these shares of its length an edge does not give at all."""
    hinges: np.ndarray
    """(Q, 4) int32: the ends of an inner edge, then the vertices opposite."""
    hinge_weights: np.ndarray
    """(Q, 4) bending stencils."""
    hinge_moves: np.ndarray
    """(Q, 4) how far each vertex is moved in a substep, over the stencil's value."""
    inverse_masses: np.ndarray
    """(V,), 0 for a vertex that is pinned."""
    faces: np.ndarray
    """(F, 3) int32."""
    areas: np.ndarray
    """(F,) of the faces on the pattern."""
    friction: float

    @staticmethod
    def create(mesh: PanelMesh, cloth: Cloth, pinned: np.ndarray) -> Sheet:
        """Args: pinned: vertices, (N,), that the solver does not move."""
        edges, lengths = rest_lengths(mesh)
        stencils, weights = hinges(mesh)
        areas = rest_areas(mesh)
        corners, count = mesh.faces.ravel(), mesh.vertex_count
        shares = np.bincount(corners, np.repeat(areas / 3, 3), minlength=count)
        around = np.bincount(corners, np.repeat(areas, 3), minlength=count) / np.bincount(corners, minlength=count)
        inverse_masses = 1 / (cloth.density * shares)
        inverse_masses[pinned] = 0.0
        edge_order = _by_sides(edges, mesh.mirror, mesh.vertex_uv[:, 1])
        hinge_order = _by_sides(stencils[:, :2], mesh.mirror, mesh.vertex_uv[:, 1])
        edges, lengths = edges[edge_order], lengths[edge_order]
        both = inverse_masses[edges].sum(axis=1)
        gives = 1 / (np.array([cloth.stretch_stiffness, np.inf, cloth.compression_stiffness]) * SUBSTEP_S**2)
        firmness = np.array([cloth.over_relaxation, 1.0, 1.0]) / np.maximum(both[:, None] + gives, 1e-9)
        firmness[both == 0] = 0
        stencils, weights = stencils[hinge_order], weights[hinge_order, :4]
        # Energy of a hinge: 3 k / (A1 + A2) times half the squared stencil; A from the faces around its corners.
        hinge_give = 2 * around[stencils].mean(axis=1) / (3 * cloth.bending) / SUBSTEP_S**2
        pulled = weights * inverse_masses[stencils]
        return Sheet(
            edges=np.ascontiguousarray(edges, np.int32),
            lengths=lengths,
            edge_firmness=firmness,
            strain_limits=(cloth.compression_limit, cloth.strain_limit),
            hinges=np.ascontiguousarray(stencils, np.int32),
            hinge_weights=np.ascontiguousarray(weights),
            hinge_moves=pulled / ((weights * pulled).sum(axis=1) + hinge_give)[:, None],
            inverse_masses=inverse_masses,
            faces=np.ascontiguousarray(mesh.faces, np.int32),
            areas=areas,
            friction=cloth.friction,
        )


def _by_sides(edges: np.ndarray, mirror: np.ndarray | None, heights: np.ndarray) -> np.ndarray:
    """An order of edges, (E, 2), from the top of the draft downwards, in which each is followed by its mirror image."""
    downwards = -np.round(heights[edges].mean(axis=1), 5)
    if mirror is None:
        return np.argsort(downwards, kind="stable")
    own, image = (np.sort(each, axis=1).astype(np.int64) @ (len(mirror), 1) for each in (edges, mirror[edges]))
    return np.lexsort((own, np.minimum(own, image), downwards))


@dataclass(frozen=True, slots=True, eq=False)
class Planes:
    """The body near the cloth: half planes that vertices are kept out of; a vertex may have several, or none."""

    vertices: np.ndarray
    """(C,) int32."""
    points: np.ndarray
    """(C, 3) nearest body points."""
    normals: np.ndarray
    """(C, 3) smooth body normals there."""


def advance(
    sheet: Sheet,
    positions: np.ndarray,
    velocities: np.ndarray,
    hold: tuple[np.ndarray, np.ndarray],
    planes: Planes,
    *,
    margin: float,
    keep: float,
    substeps: int,
) -> None:
    """Move positions and velocities, both (V, 3) float64 and changed in place, by some substeps.

    Args:
        hold: where the vertices are held, (V, 3), and the share of the way there that each is pulled, (V,).
        margin: distance at which the cloth lies over the body.
        keep: share of the velocity that is left after a substep.
    """
    _advance(
        positions,
        velocities,
        sheet.inverse_masses,
        sheet.edges,
        sheet.lengths,
        sheet.edge_firmness,
        *sheet.strain_limits,
        sheet.hinges,
        sheet.hinge_weights,
        sheet.hinge_moves,
        *hold,
        planes.vertices,
        planes.points,
        planes.normals,
        margin,
        sheet.friction,
        keep,
        substeps,
    )


def keep_lengths(sheet: Sheet, positions: np.ndarray) -> None:
    """Move positions, (V, 3) float64 and changed in place, until edges and the areas of faces are about within their
    limits: one sweep there, one back, one over the faces."""
    _keep_lengths(
        positions, sheet.inverse_masses, sheet.edges, sheet.lengths, sheet.edge_firmness * (0, 1, 0),
        *sheet.strain_limits, sheet.faces, sheet.areas, *AREA_LIMITS,
    )  # fmt: skip


def push_out(positions: np.ndarray, planes: Planes, *, margin: float, farthest: float = np.inf) -> None:
    """Move positions, (V, 3) float64 and changed in place, out of the half planes of their vertices.

    Args:
        margin: distance from them to which they are moved, metres.
        farthest: no vertex is moved farther by one of its planes, metres.
    """
    _push_out(positions, planes.vertices, planes.points, planes.normals, margin, farthest)


@njit(cache=True, nogil=True)
def _push_out(x, touching, plane_points, plane_normals, margin, farthest):
    for c in range(len(touching)):
        i, height = touching[c], -margin
        for k in range(3):
            height += (x[i, k] - plane_points[c, k]) * plane_normals[c, k]
        if height < 0:
            move = min(-height, farthest)
            for k in range(3):
                x[i, k] += move * plane_normals[c, k]


@njit(cache=True, fastmath=True, nogil=True)
def _keep_lengths(
    x, inverse_mass, edges, lengths, firmness, shortest, longest, faces, areas, smallest, largest
):  # fmt: skip
    _stretch(x, inverse_mass, edges, lengths, firmness, shortest, longest, True)
    _stretch(x, inverse_mass, edges, lengths, firmness, shortest, longest, False)
    normal, gradient = np.empty(3), np.empty((3, 3))
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        _cross(x[b] - x[a], x[c] - x[a], normal)
        area = 0.5 * np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
        excess = area - min(max(area, smallest * areas[f]), largest * areas[f])
        if excess == 0.0 or area < 1e-9:
            continue
        normal /= 2 * area
        moved = 1e-12
        for k in range(3):
            _cross(normal, x[faces[f, (k + 2) % 3]] - x[faces[f, (k + 1) % 3]], gradient[k])
            for m in range(3):
                gradient[k, m] *= 0.5
                moved += inverse_mass[faces[f, k]] * gradient[k, m] ** 2
        for k in range(3):
            for m in range(3):
                x[faces[f, k], m] -= excess / moved * inverse_mass[faces[f, k]] * gradient[k, m]


@njit(cache=True, fastmath=True, nogil=True, inline="always")
def _cross(a, b, out):
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def _advance(
    x,
    velocity,
    inverse_mass,
    edges,
    lengths,
    firmness,
    shortest,
    longest,
    hinges,
    weights,
    moves,
    held_at,
    held,
    touching,
    plane_points,
    plane_normals,
    margin,
    friction,
    keep,
    substeps,
):
    h = SUBSTEP_S
    before = x.copy()
    for substep in range(substeps):
        for i in range(len(x)):
            if inverse_mass[i] > 0:
                velocity[i, 1] -= GRAVITY * h
            for k in range(3):
                before[i, k] = x[i, k]
                x[i, k] += h * velocity[i, k]
                x[i, k] += held[i] * (held_at[i, k] - x[i, k])
        for c in range(len(touching)):
            i = touching[c]
            nx, ny, nz = plane_normals[c, 0], plane_normals[c, 1], plane_normals[c, 2]
            height = (
                (x[i, 0] - plane_points[c, 0]) * nx
                + (x[i, 1] - plane_points[c, 1]) * ny
                + (x[i, 2] - plane_points[c, 2]) * nz
                - margin
            )
            height = max(height, -OUTWARDS_M)
            if height < 0 and inverse_mass[i] > 0:
                x[i, 0] -= height * nx
                x[i, 1] -= height * ny
                x[i, 2] -= height * nz
                tx, ty, tz = x[i, 0] - before[i, 0], x[i, 1] - before[i, 1], x[i, 2] - before[i, 2]
                along = tx * nx + ty * ny + tz * nz
                tx, ty, tz = tx - along * nx, ty - along * ny, tz - along * nz
                slid = np.sqrt(tx * tx + ty * ty + tz * tz) + 1e-12
                stuck = min(1.0, -friction * height / slid)
                x[i, 0] -= stuck * tx
                x[i, 1] -= stuck * ty
                x[i, 2] -= stuck * tz
        _bend(x, hinges, weights, moves, substep % 2 == 0)
        _stretch(x, inverse_mass, edges, lengths, firmness, shortest, longest, substep % 2 == 0)
        for i in range(len(x)):
            dx, dy, dz = x[i, 0] - before[i, 0], x[i, 1] - before[i, 1], x[i, 2] - before[i, 2]
            gain = keep / h * min(1.0, FARTHEST_M / (np.sqrt(dx * dx + dy * dy + dz * dz) + 1e-12))
            velocity[i, 0], velocity[i, 1], velocity[i, 2] = gain * dx, gain * dy, gain * dz


@njit(cache=True, fastmath=True, nogil=True, inline="always")
def _bend(x, hinges, weights, moves, forward):
    for q in range(len(hinges)):
        e = q if forward else len(hinges) - 1 - q
        a, b, c, d = hinges[e, 0], hinges[e, 1], hinges[e, 2], hinges[e, 3]
        wa, wb, wc, wd = weights[e, 0], weights[e, 1], weights[e, 2], weights[e, 3]
        ma, mb, mc, md = moves[e, 0], moves[e, 1], moves[e, 2], moves[e, 3]
        for k in range(3):
            bent = wa * x[a, k] + wb * x[b, k] + wc * x[c, k] + wd * x[d, k]
            x[a, k] -= ma * bent
            x[b, k] -= mb * bent
            x[c, k] -= mc * bent
            x[d, k] -= md * bent


@njit(cache=True, fastmath=True, nogil=True, inline="always")
def _stretch(x, inverse_mass, edges, lengths, firmness, shortest, longest, forward):
    for q in range(len(edges)):
        e = q if forward else len(edges) - 1 - q
        i, j = edges[e, 0], edges[e, 1]
        mi, mj = inverse_mass[i], inverse_mass[j]
        dx, dy, dz = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
        size = np.sqrt(dx * dx + dy * dy + dz * dz) + 1e-9
        length = lengths[e]
        if size > length:
            move = max((size - length) * firmness[e, 0], (size - longest * length) * firmness[e, 1]) / size
        else:
            move = min((size - length) * firmness[e, 2], (size - shortest * length) * firmness[e, 1]) / size
        x[i, 0] += mi * move * dx
        x[i, 1] += mi * move * dy
        x[i, 2] += mi * move * dz
        x[j, 0] -= mj * move * dx
        x[j, 1] -= mj * move * dy
        x[j, 2] -= mj * move * dz
