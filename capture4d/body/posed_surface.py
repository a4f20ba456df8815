"""How a skinned body's surface answers to its pose and shape: closest points, and their analytic derivatives.

Letters: V vertices, J joints, S shape components, N matched points, P = 3 + 3 J + S parameters, in this order:

    translation of the root      3, metres
    rotation of every joint      3 J, radians; R_j <- exp(w_j) R_j, so w_j lives in the axes of the parent
    shape                        S, standard deviations

A surface point p = sum_k w_k T_k x moves with a turn of joint j about its centre c_j by w x (A_j - W_j c_j), where A_j
sums w_k T_k x, and W_j sums w_k, over the joints at and below j. One pass up the tree gives all A and W, so a row costs
as much as the skinning does; automatic differentiation of the same chain took a second.

Pose correctives of the SMPL family move the surface but are held constant in the derivative.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int32
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from capture4d.body.skinning import PosedBody, with_pose, with_shape
from capture4d.geometry.mesh import face_areas
from capture4d.geometry.mesh_kernels import vertex_normals_kernel
from capture4d.geometry.triangles import closest_on_faces
from capture4d.heavy_imports import njit
from capture4d.types import Body

__all__ = ["BodyState", "Matches", "PosedSurface", "TrackedBody", "linearise", "match", "pose_surface", "tracked_body"]

SURFACE_SAMPLES = 8000
"""Points spread over the body by area; they find the faces near a scan point. 15 mm apart on an adult."""
NORMAL_REACH_M = 0.04
"""A match between opposite normals costs as much as one twice this far away: arms do not match the trunk's side."""


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
    influences = int((body.skin_weights > 0).sum(axis=1).max())
    order = np.argsort(-body.skin_weights, axis=1, kind="stable")[:, :influences]
    weights = np.take_along_axis(body.skin_weights, order, axis=1).astype(np.float64)
    areas = np.cumsum(face_areas(body.template.vertices.astype(np.float64), body.template.faces))
    rng = np.random.default_rng(0)
    at = (np.arange(samples) + rng.random(samples)) / samples * areas[-1]
    root, across = np.sqrt(rng.random(samples)), rng.random(samples)
    return TrackedBody(
        body=body,
        vertex_joints=order.astype(np.int32),
        vertex_weights=weights,
        shape_directions=np.ascontiguousarray(np.moveaxis(body.shape_directions, 0, 2), np.float64),
        sample_faces=np.minimum(np.searchsorted(areas, at), len(areas) - 1).astype(np.int32),
        sample_barycentric=np.stack([1 - root, root * (1 - across), root * across], axis=1),
    )


def pose_surface(model: TrackedBody, state: BodyState) -> PosedSurface:
    """Skin the body."""
    posed = with_pose(with_shape(model.body, state.shape), state.rotations, state.translation)
    vertices = _skin(_rest(model, posed), model.vertex_joints, model.vertex_weights, posed.transforms)
    return PosedSurface(model, posed, vertices, vertex_normals_kernel(vertices, model.body.template.faces))


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
    model = surface.model
    corners = model.body.template.faces[model.sample_faces]
    weights = model.sample_barycentric[:, :, None]
    places = (surface.vertices[corners] * weights).sum(axis=1)
    directions = (surface.normals[corners] * weights).sum(axis=1)
    tree = KDTree(np.hstack([places, NORMAL_REACH_M * directions]), balanced_tree=False, compact_nodes=False)
    _, nearest = tree.query(np.hstack([points, NORMAL_REACH_M * normals]), k=faces)
    candidates = model.sample_faces[nearest.reshape(len(points), faces)]
    face, barycentric = closest_on_faces(points, candidates, surface.vertices, model.body.template.faces)
    on_body, outward = _interpolate(surface.vertices, surface.normals, model.body.template.faces, face, barycentric)
    return Matches(on_body, outward, face, barycentric)


def linearise(
    surface: PosedSurface, matches: Matches, active: Bool[np.ndarray, " points"]
) -> Float64[np.ndarray, "active parameters"]:
    """Derivative of n . p with respect to all parameters for the active matches, their normals held."""
    model, posed = surface.model, surface.posed
    centres, offsets = _centres_and_shape_offsets(model.body, posed)
    world = posed.transforms[:, :3, :3]
    parents = model.body.parents
    parent_world = np.where((parents < 0)[:, None, None], np.eye(3), world[np.maximum(parents, 0)])
    return _rows(
        matches.faces[active],
        matches.barycentric[active],
        np.ascontiguousarray(matches.normals[active]),
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


@njit(cache=True)
def _skin(rest, joints, weights, transforms):
    result = np.zeros((len(rest), 3))
    for v in range(len(rest)):
        for k in range(joints.shape[1]):
            w = weights[v, k]
            if w == 0.0:
                break
            T = transforms[joints[v, k]]
            for a in range(3):
                result[v, a] += w * (T[a, 0] * rest[v, 0] + T[a, 1] * rest[v, 1] + T[a, 2] * rest[v, 2] + T[a, 3])
    return result


@njit(cache=True)
def _rows(
    faces_of, barycentric, normals, faces, rest, joints, weights, directions, transforms, centres, offsets,
    parent_world, parents,
):  # fmt: skip
    count, joint_count, shape_count = len(faces_of), len(parents), offsets.shape[2]
    rows = np.zeros((count, 3 + 3 * joint_count + shape_count))
    moment = np.zeros((joint_count, 3))
    share = np.zeros(joint_count)
    first_shape = 3 + 3 * joint_count
    for i in range(count):
        moment[:] = 0.0
        share[:] = 0.0
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        rows[i, 0], rows[i, 1], rows[i, 2] = nx, ny, nz
        for corner in range(3):
            v = faces[faces_of[i], corner]
            for k in range(joints.shape[1]):
                w = weights[v, k] * barycentric[i, corner]
                if weights[v, k] == 0.0:
                    break
                j = joints[v, k]
                T = transforms[j]
                for a in range(3):
                    place = T[a, 0] * rest[v, 0] + T[a, 1] * rest[v, 1] + T[a, 2] * rest[v, 2] + T[a, 3]
                    moment[j, a] += w * place
                share[j] += w
                bx = w * (T[0, 0] * nx + T[1, 0] * ny + T[2, 0] * nz)
                by = w * (T[0, 1] * nx + T[1, 1] * ny + T[2, 1] * nz)
                bz = w * (T[0, 2] * nx + T[1, 2] * ny + T[2, 2] * nz)
                for s in range(shape_count):
                    rows[i, first_shape + s] += (
                        bx * directions[v, 0, s] + by * directions[v, 1, s] + bz * directions[v, 2, s]
                        + w * (nx * offsets[j, 0, s] + ny * offsets[j, 1, s] + nz * offsets[j, 2, s])
                    )  # fmt: skip
        for j in range(joint_count - 1, -1, -1):
            if share[j] == 0.0:
                continue
            ax = moment[j, 0] - share[j] * centres[j, 0]
            ay = moment[j, 1] - share[j] * centres[j, 1]
            az = moment[j, 2] - share[j] * centres[j, 2]
            tx, ty, tz = ay * nz - az * ny, az * nx - ax * nz, ax * ny - ay * nx
            R = parent_world[j]
            for a in range(3):
                rows[i, 3 + 3 * j + a] = R[0, a] * tx + R[1, a] * ty + R[2, a] * tz
            if parents[j] >= 0:
                share[parents[j]] += share[j]
                for a in range(3):
                    moment[parents[j], a] += moment[j, a]
    return rows


@njit(cache=True)
def _interpolate(vertices, normals, faces, face_of, barycentric):
    points = np.zeros((len(face_of), 3))
    outward = np.zeros((len(face_of), 3))
    for i in range(len(face_of)):
        for corner in range(3):
            v = faces[face_of[i], corner]
            for a in range(3):
                points[i, a] += barycentric[i, corner] * vertices[v, a]
                outward[i, a] += barycentric[i, corner] * normals[v, a]
        length = np.sqrt(outward[i, 0] ** 2 + outward[i, 1] ** 2 + outward[i, 2] ** 2)
        if length > 0.0:
            for a in range(3):
                outward[i, a] /= length
    return points, outward
