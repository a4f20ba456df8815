"""Points to pixels and back, through two kinds of lenses, and the derivatives.

`brown` is OpenCV's pinhole camera with distortion k1 k2 p1 p2 k3, `fisheye` its equidistant one (cv2.fisheye; Kannala
and Brandt, PAMI 2006) with k1 k2 k3 k4. The models are those of OpenCV's calib3d documentation.

Letters: X a point in the camera's axes, metres; x = X / Z its normalised coordinates; t its angle to the axis, and
d(t) = t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) what a fisheye makes of it; u a pixel, centres at integers. A twist
(w, t), radians and metres, moves X to X + w x X + t to first order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import assert_never

import numpy as np
from jaxtyping import Bool, Float64

from capture4d.types import LensModel, Rig

__all__ = [
    "LENS_PARAMETERS",
    "Lens",
    "camera_lens",
    "cross_matrix",
    "lens_jacobian",
    "point_jacobian",
    "project",
    "project_world",
    "rays",
    "rotation_angle_deg",
    "rotation_from_vector",
    "transform",
    "triangulate",
    "twist_jacobian",
    "undistort",
]

LENS_PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
"""What a calibration solves for; k3 stays as it is. The last two are k3 and k4 of a fisheye."""
UNDISTORT_STEPS = 12
FISHEYE_STEPS = 30
_POWERS = np.array([2, 4, 6, 8])


@dataclass(frozen=True, slots=True, eq=False)
class Lens:
    """How one camera makes pixels of points."""

    intrinsics: Float64[np.ndarray, "3 3"]
    distortion: Float64[np.ndarray, " 5"]
    """k1 k2 p1 p2 k3, or k1 k2 k3 k4 0 of a fisheye."""
    model: LensModel = "brown"

    @property
    def widest(self) -> float:
        """Angle to the axis, radians, up to which a fisheye's image moves outwards; there is nothing beyond."""
        slope = [*(self.distortion[:4] * (_POWERS + 1))[::-1], 1.0]
        squared = np.roots(slope)
        turns = squared[(np.abs(squared.imag) < 1e-12) & (squared.real > 0)].real
        return min(float(np.sqrt(turns.min(initial=np.inf))), np.pi)


def camera_lens(rig: Rig, camera: int) -> Lens:
    """The lens of one camera of a rig."""
    return Lens(rig.intrinsics[camera], rig.distortion[camera], rig.lenses[camera])


def project(points: Float64[np.ndarray, "points 3"], lens: Lens) -> Float64[np.ndarray, "points 2"]:
    """Pixels of points in the camera's axes; they must lie in front of it, or within a fisheye's widest angle."""
    return _bend(points, lens)[0] @ lens.intrinsics[:2, :2].T + lens.intrinsics[:2, 2]


def project_world(
    rig: Rig, camera: int, points: Float64[np.ndarray, "points 3"]
) -> tuple[Float64[np.ndarray, "points 2"], Bool[np.ndarray, " points"]]:
    """Pixels of world points in one camera of a rig, and which of them it can see: in front, and inside the image."""
    local, lens = transform(rig.T_camera_world[camera], points), camera_lens(rig, camera)
    if lens.model == "fisheye":
        angles = np.arctan2(np.hypot(local[:, 0], local[:, 1]), local[:, 2])
        front = (angles < lens.widest) & (np.abs(local).max(axis=1, initial=0) > 1e-9)
    else:
        front = local[:, 2] > 1e-9
    pixels = project(np.where(front[:, None], local, (0.0, 0.0, 1.0)), lens)
    inside = ((pixels > -0.5) & (pixels < rig.image_sizes[camera] - 0.5)).all(axis=1)
    return pixels, front & inside


def point_jacobian(points: Float64[np.ndarray, "points 3"], lens: Lens) -> Float64[np.ndarray, "points 2 3"]:
    """Derivative of the pixels by the points."""
    return lens.intrinsics[:2, :2] @ _bend(points, lens)[1]


def lens_jacobian(points: Float64[np.ndarray, "points 3"], lens: Lens) -> Float64[np.ndarray, "points 2 8"]:
    """Derivative of the pixels by LENS_PARAMETERS."""
    moved, _ = _bend(points, lens)
    jacobian = np.zeros((len(points), 2, 8))
    jacobian[:, 0, 0], jacobian[:, 1, 1] = moved.T
    jacobian[:, 0, 2] = jacobian[:, 1, 3] = 1
    if lens.model == "fisheye":
        across = np.linalg.norm(points[:, :2], axis=1)
        angles = np.arctan2(across, points[:, 2])
        outwards = points[:, :2] / np.maximum(across, 1e-300)[:, None]
        by_distortion = outwards.T[:, None] * angles ** (_POWERS[:, None] + 1)
    else:
        x, y = (points[:, :2] / points[:, 2:]).T
        r2 = x * x + y * y
        by_distortion = np.array(
            [[x * r2, x * r2 * r2, 2 * x * y, r2 + 2 * x * x], [y * r2, y * r2 * r2, r2 + 2 * y * y, 2 * x * y]]
        )
    jacobian[:, :, 4:] = np.einsum("ij,jkn->nik", lens.intrinsics[:2, :2], by_distortion)
    return jacobian


def twist_jacobian(points: Float64[np.ndarray, "points 3"]) -> Float64[np.ndarray, "points 3 6"]:
    """Derivative of points by a twist (w, t) of their frame."""
    jacobian = np.zeros((len(points), 3, 6))
    jacobian[:, :, :3] = -cross_matrix(points)
    jacobian[:, :, 3:] = np.eye(3)
    return jacobian


def rays(pixels: Float64[np.ndarray, "points 2"], lens: Lens) -> Float64[np.ndarray, "points 3"]:
    """Directions of length one in which pixels look; NaN where a lens shows nothing."""
    if lens.model == "fisheye":
        target = np.linalg.solve(lens.intrinsics[:2, :2], (pixels - lens.intrinsics[:2, 2]).T).T
        length = np.linalg.norm(target, axis=1)
        angles = _angles(length, lens)
        across = np.sin(angles) / np.maximum(length, 1e-300)
        return np.column_stack([across[:, None] * target, np.cos(angles)])
    found = np.column_stack([undistort(pixels, lens), np.ones(len(pixels))])
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def undistort(pixels: Float64[np.ndarray, "points 2"], lens: Lens) -> Float64[np.ndarray, "points 2"]:
    """Normalised coordinates of pixels; NaN where they look sideways or back."""
    if lens.model == "fisheye":
        looks = rays(pixels, lens)
        return looks[:, :2] / np.where(looks[:, 2:] > 1e-6, looks[:, 2:], np.nan)
    target = np.linalg.solve(lens.intrinsics[:2, :2], (pixels - lens.intrinsics[:2, 2]).T).T
    normalised = target.copy()
    for _ in range(UNDISTORT_STEPS):
        moved, jacobian = _distort(normalised, lens.distortion)
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
            looks = rays(pixels[camera, rows], camera_lens(rig, camera)) @ rotation
            across = np.eye(3) - looks[:, :, None] * looks[:, None, :]
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


# --- the two models ----------------------------------------------------------------------------------------------


def _bend(
    points: Float64[np.ndarray, "points 3"], lens: Lens
) -> tuple[Float64[np.ndarray, "points 2"], Float64[np.ndarray, "points 2 3"]]:
    """Where a lens of focal length one puts points, and the derivative of that."""
    match lens.model:
        case "brown":
            return _bend_brown(points, lens.distortion)
        case "fisheye":
            return _bend_fisheye(points, lens.distortion[:4])
        case _:
            assert_never(lens.model)


def _bend_brown(
    points: Float64[np.ndarray, "points 3"], distortion: Float64[np.ndarray, " 5"]
) -> tuple[Float64[np.ndarray, "points 2"], Float64[np.ndarray, "points 2 3"]]:
    normalised = points[:, :2] / points[:, 2:]
    moved, by_normalised = _distort(normalised, distortion)
    by_point = np.zeros((len(points), 2, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = 1 / points[:, 2]
    by_point[:, :, 2] = -normalised / points[:, 2:]
    return moved, by_normalised @ by_point


def _distort(
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


def _bend_fisheye(
    points: Float64[np.ndarray, "points 3"], distortion: Float64[np.ndarray, " 4"]
) -> tuple[Float64[np.ndarray, "points 2"], Float64[np.ndarray, "points 2 3"]]:
    flat, z = points[:, :2], points[:, 2]
    across, squared = np.linalg.norm(flat, axis=1), (points * points).sum(axis=1)
    angles = np.arctan2(across, z)
    bent, slope = _fisheye_radius(angles, distortion)
    off_axis = across > 1e-9 * np.sqrt(squared)
    r = np.where(off_axis, across, 1.0)
    scale = np.where(off_axis, bent / r, 1 / np.where(z > 0, z, np.inf))
    curve = np.where(off_axis, (slope * z / squared - scale) / (r * r), 0.0)
    by_point = np.empty((len(points), 2, 3))
    by_point[:, :, :2] = curve[:, None, None] * flat[:, :, None] * flat[:, None, :] + scale[:, None, None] * np.eye(2)
    by_point[:, :, 2] = -(slope / squared)[:, None] * flat
    return scale[:, None] * flat, by_point


def _fisheye_radius(
    angles: Float64[np.ndarray, " points"], distortion: Float64[np.ndarray, " 4"]
) -> tuple[Float64[np.ndarray, " points"], Float64[np.ndarray, " points"]]:
    """d, and its derivative."""
    powers = angles[:, None] ** _POWERS
    return angles * (1 + powers @ distortion), 1 + powers @ (distortion * (_POWERS + 1))


def _angles(lengths: Float64[np.ndarray, " points"], lens: Lens) -> Float64[np.ndarray, " points"]:
    """t with d(t) = length, by Newton's method within the range in which d grows; NaN if there is none."""
    low, high = np.zeros(len(lengths)), np.full(len(lengths), lens.widest)
    angles = np.minimum(lengths, lens.widest)
    for _ in range(FISHEYE_STEPS):
        bent, slope = _fisheye_radius(angles, lens.distortion[:4])
        low, high = np.where(bent < lengths, angles, low), np.where(bent > lengths, angles, high)
        newton = angles - (bent - lengths) / np.maximum(slope, 1e-12)
        angles = np.where((newton >= low) & (newton <= high), newton, (low + high) / 2)
    off = np.abs(_fisheye_radius(angles, lens.distortion[:4])[0] - lengths)
    return np.where(off < 1e-9, angles, np.nan)
