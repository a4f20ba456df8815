"""Points to pixels and back: OpenCV's pinhole camera with distortion k1 k2 p1 p2 k3, and its derivatives.

Letters: X a point in the camera's axes, metres; x = X / Z its normalised coordinates; u a pixel, centres at integers.
The model is the one of OpenCV's calib3d documentation. A twist (w, t), radians and metres, moves X to X + w x X + t to
first order.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64

from capture4d.types import Rig

__all__ = [
    "LENS_PARAMETERS",
    "cross_matrix",
    "distort",
    "lens_jacobian",
    "point_jacobian",
    "project",
    "project_world",
    "rotation_angle_deg",
    "rotation_from_vector",
    "transform",
    "triangulate",
    "twist_jacobian",
    "undistort",
]

LENS_PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
"""What a calibration solves for; k3 stays as it is."""
UNDISTORT_STEPS = 12


def distort(
    normalised: Float64[np.ndarray, "points 2"], distortion: Float64[np.ndarray, " 5"]
) -> tuple[Float64[np.ndarray, "points 2"], Float64[np.ndarray, "points 2 2"]]:
    """Where the lens moves normalised coordinates, and the derivative of that."""
    k1, k2, p1, p2, k3 = distortion
    x, y = normalised[:, 0], normalised[:, 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2 * k2 + 3 * k3 * r2)
    moved = np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=1,
    )
    jacobian = np.empty((len(x), 2, 2))
    jacobian[:, 0, 0] = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    jacobian[:, 1, 1] = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    jacobian[:, 0, 1] = jacobian[:, 1, 0] = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    return moved, jacobian


def project(
    points: Float64[np.ndarray, "points 3"],
    intrinsics: Float64[np.ndarray, "3 3"],
    distortion: Float64[np.ndarray, " 5"],
) -> Float64[np.ndarray, "points 2"]:
    """Pixels of points in the camera's axes; they must lie in front of it."""
    moved, _ = distort(points[:, :2] / points[:, 2:], distortion)
    return moved @ intrinsics[:2, :2].T + intrinsics[:2, 2]


def project_world(
    rig: Rig, camera: int, points: Float64[np.ndarray, "points 3"]
) -> tuple[Float64[np.ndarray, "points 2"], Bool[np.ndarray, " points"]]:
    """Pixels of world points in one camera of a rig, and which of them it can see: in front, and inside the image."""
    local = transform(rig.T_camera_world[camera], points)
    front = local[:, 2] > 1e-9
    pixels = project(np.where(front[:, None], local, (0.0, 0.0, 1.0)), rig.intrinsics[camera], rig.distortion[camera])
    inside = ((pixels > -0.5) & (pixels < rig.image_sizes[camera] - 0.5)).all(axis=1)
    return pixels, front & inside


def point_jacobian(
    points: Float64[np.ndarray, "points 3"],
    intrinsics: Float64[np.ndarray, "3 3"],
    distortion: Float64[np.ndarray, " 5"],
) -> Float64[np.ndarray, "points 2 3"]:
    """Derivative of the pixels by the points."""
    normalised = points[:, :2] / points[:, 2:]
    _, by_normalised = distort(normalised, distortion)
    by_point = np.zeros((len(points), 2, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = 1 / points[:, 2]
    by_point[:, :, 2] = -normalised / points[:, 2:]
    return intrinsics[:2, :2] @ by_normalised @ by_point


def lens_jacobian(
    points: Float64[np.ndarray, "points 3"],
    intrinsics: Float64[np.ndarray, "3 3"],
    distortion: Float64[np.ndarray, " 5"],
) -> Float64[np.ndarray, "points 2 8"]:
    """Derivative of the pixels by LENS_PARAMETERS."""
    normalised = points[:, :2] / points[:, 2:]
    moved, _ = distort(normalised, distortion)
    x, y = normalised.T
    r2 = x * x + y * y
    jacobian = np.zeros((len(points), 2, 8))
    jacobian[:, 0, 0], jacobian[:, 1, 1] = moved.T
    jacobian[:, 0, 2] = jacobian[:, 1, 3] = 1
    by_distortion = np.array(
        [[x * r2, x * r2 * r2, 2 * x * y, r2 + 2 * x * x], [y * r2, y * r2 * r2, r2 + 2 * y * y, 2 * x * y]]
    )
    jacobian[:, :, 4:] = np.einsum("ij,jkn->nik", intrinsics[:2, :2], by_distortion)
    return jacobian


def twist_jacobian(points: Float64[np.ndarray, "points 3"]) -> Float64[np.ndarray, "points 3 6"]:
    """Derivative of points by a twist (w, t) of their frame."""
    jacobian = np.zeros((len(points), 3, 6))
    jacobian[:, :, :3] = -cross_matrix(points)
    jacobian[:, :, 3:] = np.eye(3)
    return jacobian


def undistort(
    pixels: Float64[np.ndarray, "points 2"],
    intrinsics: Float64[np.ndarray, "3 3"],
    distortion: Float64[np.ndarray, " 5"],
) -> Float64[np.ndarray, "points 2"]:
    """Normalised coordinates of pixels, by Newton's method."""
    target = np.linalg.solve(intrinsics[:2, :2], (pixels - intrinsics[:2, 2]).T).T
    normalised = target.copy()
    for _ in range(UNDISTORT_STEPS):
        moved, jacobian = distort(normalised, distortion)
        step = np.linalg.solve(jacobian, (target - moved)[:, :, None])[:, :, 0]
        normalised += step
        if np.abs(step).max(initial=0) < 1e-14:
            break
    return normalised


def triangulate(
    rig: Rig, pixels: Float64[np.ndarray, "cameras points 2"], seen: Bool[np.ndarray, "cameras points"]
) -> Float64[np.ndarray, "points 3"]:
    """World points with the least squared distance to the rays of the cameras that see them.

    Distances count in units of the point's depth, so that cameras far away weigh less.

    Returns:
        NaN where fewer than two cameras see the point.
    """
    count = pixels.shape[1]
    enough = seen.sum(axis=0) >= 2
    points = np.full((count, 3), np.nan)
    depth = np.ones((len(rig.names), count))
    for _ in range(2):
        system, target = np.zeros((count, 3, 3)), np.zeros((count, 3))
        for camera in range(len(rig.names)):
            rows = np.flatnonzero(seen[camera] & enough)
            rotation, centre = rig.T_camera_world[camera, :3, :3], rig.centres[camera]
            normalised = undistort(pixels[camera, rows], rig.intrinsics[camera], rig.distortion[camera])
            rays = np.concatenate([normalised, np.ones((len(rows), 1))], axis=1) @ rotation
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
            across /= depth[camera, rows, None, None] ** 2
            system[rows] += across
            target[rows] += across @ centre
        points[enough] = np.linalg.solve(system[enough], target[enough, :, None])[:, :, 0]
        depth = np.linalg.norm(points[None] - rig.centres[:, None], axis=2)
    return points


def transform(
    matrix: Float64[np.ndarray, "4 4"], points: Float64[np.ndarray, "points 3"]
) -> Float64[np.ndarray, "points 3"]:
    """Points in another frame: T_a_b takes coordinates in b to a."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def cross_matrix(vectors: Float64[np.ndarray, "*batch 3"]) -> Float64[np.ndarray, "*batch 3 3"]:
    """[v] with [v] a = v x a."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def rotation_from_vector(vector: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "3 3"]:
    """Rodrigues' formula: a turn by |v| radians about v."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3) + cross_matrix(vector)
    axis = cross_matrix(vector / angle)
    return np.eye(3) + np.sin(angle) * axis + (1 - np.cos(angle)) * axis @ axis


def rotation_angle_deg(rotations: Float64[np.ndarray, "turns 3 3"]) -> Float64[np.ndarray, " turns"]:
    """Angles of rotations, exact for small ones too."""
    skew = rotations - np.swapaxes(rotations, -1, -2)
    sine = np.linalg.norm(np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1), axis=-1)
    return np.degrees(np.arctan2(sine, np.trace(rotations, axis1=-2, axis2=-1) - 1))
