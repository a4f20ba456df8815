"""How a skinned body's surface answers to its pose and shape: closest points, and their analytic derivatives.

Letters: V vertices, J joints, S shape components, N matched points, P = 3 + 3 J + S parameters, in this order:

    translation of the root      3, metres
    rotation of every joint      3 J, radians; R_j <- exp(w_j) R_j, so w_j lives in the axes of the parent
    shape                        S, standard deviations

A surface point p = sum_k w_k T_k x moves with a turn of joint j about its centre c_j by w x (A_j - W_j c_j), where A_j
sums w_k T_k x, and W_j sums w_k, over the joints at and below j. One pass up the tree gives all A and W, so a row costs
as much as the skinning does; automatic differentiation of the same chain took a second. A row has entries for the
joints above its point alone, so that normal equations are added up row by row, without the rows.

Pose correctives of the SMPL family move the surface but are held constant in the derivative.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int32
from scipy.spatial.transform import Rotation

from capture4d.body.skinning import PosedBody, ShapedBody, sparse_weights, with_pose
from capture4d.body.surface_kernels import add_up_rows, fill_rows, nearest_samples, skin_sparse, spread_samples
from capture4d.geometry.mesh import face_areas
from capture4d.geometry.mesh_kernels import vertex_normals_kernel
from capture4d.geometry.point_grid import PointGrid
from capture4d.geometry.triangles import closest_on_faces
from capture4d.types import Body

__all__ = [
    "BodyState",
    "Matches",
    "PosedSurface",
    "TrackedBody",
    "linearise",
    "match",
    "normal_equations",
    "pose_surface",
    "tracked_body",
]

SURFACE_SAMPLES = 8000
"""Points spread over the body by area; they find the faces near a scan point. 15 mm apart on an adult."""
NORMAL_REACH_M = 0.04
"""A match between opposite normals costs as much as one twice this far away: arms do not match the trunk's side."""
CELL_M = 0.04
"""Cells in which samples are looked for: larger ones hold too many, and in smaller ones those who are far off, as while
a pose is searched for, pass too many that are empty."""


@dataclass(frozen=True, slots=True, eq=False)
class BodyState:
    """Pose and shape, in float64 while they are solved for."""

    rotations: Float64[np.ndarray, "joints 3 3"]
    translation: Float64[np.ndarray, "3"]
    shape: Float64[np.ndarray, " shapes"]

    def moved(self, step: Float64[np.ndarray, " parameters"]) -> BodyState:
        """After a step in the parameters; one without shape entries keeps the shape."""
        count = len(self.rotations)
        turns = Rotation.from_rotvec(step[3 : 3 + 3 * count].reshape(count, 3)).as_matrix()
        shape = self.shape if len(step) == 3 + 3 * count else self.shape + step[3 + 3 * count :]
        return BodyState(turns @ self.rotations, self.translation + step[:3], shape)


@dataclass(frozen=True, slots=True, eq=False)
class TrackedBody:
    """A body with what every frame needs of it, found once."""

    body: Body
    vertex_joints: Int32[np.ndarray, "verts influences"]
    vertex_weights: Float64[np.ndarray, "verts influences"]
    """Weights of `vertex_joints`; zero where a vertex has fewer influences."""
    shape_directions: Float64[np.ndarray, "verts 3 shapes"]
    sample_faces: Int32[np.ndarray, " samples"]
    sample_barycentric: Float64[np.ndarray, "samples 3"]
    face_groups: Int32[np.ndarray, " faces"]
    """Faces of one group are moved by the same joints."""
    group_starts: Int32[np.ndarray, " groups1"]
    """Where the joints of each group begin in `group_joints`, and where the last ones end."""
    group_joints: Int32[np.ndarray, " entries"]
    """Joints that move a face, those that it has weights of and all above them, children first."""

    def rest_state(self) -> BodyState:
        joints, shapes = len(self.body.joint_names), len(self.body.shape_directions)
        return BodyState(np.repeat(np.eye(3)[None], joints, axis=0), np.zeros(3), np.zeros(shapes))


@dataclass(frozen=True, slots=True, eq=False)
class PosedSurface:
    """The body in one state, ready to be matched."""

    model: TrackedBody
    posed: PosedBody
    vertices: Float64[np.ndarray, "verts 3"]
    normals: Float64[np.ndarray, "verts 3"]


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """The nearest body surface point of each scan point."""

    points: Float64[np.ndarray, "points 3"]
    """On the body."""
    normals: Float64[np.ndarray, "points 3"]
    faces: Int32[np.ndarray, " points"]
    barycentric: Float64[np.ndarray, "points 3"]


def tracked_body(body: Body, *, samples: int = SURFACE_SAMPLES) -> TrackedBody:
    """Sparse skin weights and surface samples of a body."""
    joints, weights = sparse_weights(body.skin_weights)
    areas = np.cumsum(face_areas(body.template.vertices.astype(np.float64), body.template.faces))
    rng = np.random.default_rng(0)
    at = (np.arange(samples) + rng.random(samples)) / samples * areas[-1]
    root, across = np.sqrt(rng.random(samples)), rng.random(samples)
    groups, starts, members = _groups(body)
    return TrackedBody(
        body=body,
        vertex_joints=joints,
        vertex_weights=weights,
        shape_directions=np.ascontiguousarray(np.moveaxis(body.shape_directions, 0, 2), np.float64),
        sample_faces=np.minimum(np.searchsorted(areas, at), len(areas) - 1).astype(np.int32),
        sample_barycentric=np.stack([1 - root, root * (1 - across), root * across], axis=1),
        face_groups=groups,
        group_starts=starts,
        group_joints=members,
    )


def _groups(body: Body) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The groups of the faces, and their joints."""
    moves = np.asarray((body.skin_weights > 0)[body.template.faces].any(axis=1))
    for joint in range(len(body.parents) - 1, 0, -1):  # parents come before their children
        moves[:, body.parents[joint]] |= moves[:, joint]
    bits = np.packbits(moves, axis=1)  # rows of bytes sort fifty times faster than rows of numbers
    _, first, groups = np.unique(
        bits.view(np.dtype((np.void, bits.shape[1]))).reshape(-1), return_index=True, return_inverse=True
    )
    group, joint = np.nonzero(moves[first][:, ::-1])
    starts = np.searchsorted(group, np.arange(len(first) + 1))
    members = len(body.parents) - 1 - joint
    return groups.reshape(-1).astype(np.int32), starts.astype(np.int32), members.astype(np.int32)


def pose_surface(model: TrackedBody, state: BodyState) -> PosedSurface:
    """Skin the body."""
    posed = with_pose(_shaped(model, state.shape), state.rotations, state.translation)
    vertices = skin_sparse(_rest(model, posed), model.vertex_joints, model.vertex_weights, posed.transforms)
    return PosedSurface(model, posed, vertices, vertex_normals_kernel(vertices, model.body.template.faces))


def _shaped(model: TrackedBody, shape: np.ndarray) -> ShapedBody:
    """`skinning.with_shape`, of directions that are float64 already: converting them would take longest."""
    body = model.body
    joints = body.joints + np.tensordot(shape, body.joint_directions, axes=1)
    return ShapedBody(body, shape, body.template.vertices + model.shape_directions @ shape, joints)


def _rest(model: TrackedBody, posed: PosedBody) -> np.ndarray:
    rest = posed.shaped.vertices
    if model.body.pose_directions is None:
        return rest
    return rest + np.tensordot((posed.rotations[1:] - np.eye(3)).ravel(), model.body.pose_directions, axes=1)


def match(
    surface: PosedSurface,
    points: Float64[np.ndarray, "points 3"],
    normals: Float64[np.ndarray, "points 3"],
    *,
    faces: int = 3,
) -> Matches:
    """The nearest body surface point of each scan point, among those with a like normal.

    Args:
        normals: of the scan, outwards; zero where unknown.
        faces: candidates to look at for each point.
    """
    model, all_faces = surface.model, surface.model.body.template.faces
    places, directions = spread_samples(
        surface.vertices, surface.normals, all_faces, model.sample_faces, model.sample_barycentric
    )
    grid = PointGrid.build(places, CELL_M)
    nearest = nearest_samples(
        np.ascontiguousarray(points), np.ascontiguousarray(normals), faces, NORMAL_REACH_M,
        grid.origin, grid.cell, grid.shape, grid.starts, grid.points, directions[grid.order],
    )  # fmt: skip
    candidates = model.sample_faces[grid.order[nearest]]
    face, barycentric = closest_on_faces(points, candidates, surface.vertices, all_faces)
    on_body, outward = spread_samples(surface.vertices, surface.normals, all_faces, face, barycentric)
    return Matches(on_body, outward / np.maximum(np.linalg.norm(outward, axis=1), 1e-300)[:, None], face, barycentric)


def linearise(
    surface: PosedSurface, matches: Matches, active: Bool[np.ndarray, " points"]
) -> Float64[np.ndarray, "active parameters"]:
    """Derivative of n . p with respect to all parameters for the active matches, their normals held."""
    own = (matches.faces[active], matches.barycentric[active], np.ascontiguousarray(matches.normals[active]))
    return fill_rows(*own, *_tree(surface))


def normal_equations(
    surface: PosedSurface,
    matches: Matches,
    weight: Float64[np.ndarray, " points"],
    residual: Float64[np.ndarray, " points"],
    *,
    with_shape: bool = True,
) -> tuple[Float64[np.ndarray, "parameters parameters"], Float64[np.ndarray, " parameters"]]:
    """J^T W J and J^T W r, with the rows of `linearise` as J.

    Args:
        weight: zero leaves a point out.
        residual: by which the surface is to move along its normals, metres.
        with_shape: False leaves the parameters of the shape out.
    """
    kept = np.flatnonzero(weight)
    order = kept[np.argsort(surface.model.face_groups[matches.faces[kept]], kind="stable")]
    normals = np.ascontiguousarray(matches.normals)
    return add_up_rows(
        order, weight, residual, with_shape, matches.faces, matches.barycentric, normals, *_tree(surface)
    )


def _tree(surface: PosedSurface) -> tuple[np.ndarray, ...]:
    """What rows are made of beside their points."""
    model, posed = surface.model, surface.posed
    centres, offsets = _centres_and_shape_offsets(model.body, posed)
    world, parents = posed.transforms[:, :3, :3], model.body.parents
    parent_world = np.where((parents < 0)[:, None, None], np.eye(3), world[np.maximum(parents, 0)])
    return (
        model.face_groups,
        model.group_starts,
        model.group_joints,
        model.body.template.faces,
        _rest(model, posed),
        model.vertex_joints,
        model.vertex_weights,
        model.shape_directions,
        np.ascontiguousarray(posed.transforms),
        centres,
        offsets,
        np.ascontiguousarray(parent_world),
        parents,
    )


def _centres_and_shape_offsets(body: Body, posed: PosedBody) -> tuple[np.ndarray, np.ndarray]:
    """World joint centres (J, 3), and (J, 3, S): how T_j x shifts with the shape for a rest point x that stays."""
    world = posed.transforms[:, :3, :3]
    centres = np.einsum("jab,jb->ja", world, posed.shaped.joints) + posed.transforms[:, :3, 3]
    at_rest = np.moveaxis(body.joint_directions, 0, 2).astype(np.float64)
    moved = np.empty_like(at_rest)
    moved[0] = at_rest[0]
    for joint in range(1, len(moved)):
        parent = body.parents[joint]
        moved[joint] = moved[parent] + world[parent] @ (at_rest[joint] - at_rest[parent])
    return centres, moved - world @ at_rest
