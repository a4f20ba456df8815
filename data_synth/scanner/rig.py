"""Rigs of a 4D capture stage: three rings of cameras, or of stereo pods, around the subject, a few above and below."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from capture4d.errors import InputError
from capture4d.types import Rig
from data_synth.scanner.config import ScannerConfig, StereoConfig

__all__ = ["bounding_sphere", "capture_rig", "look_at", "pod_rig", "scanner_rig"]

Point = tuple[float, float, float] | np.ndarray

# (name, share of the cameras, distance from the axis, height, height looked at); lengths in radii of the subject, and
# heights from its centre. The middle ring just sees the whole sphere. At a radius of 0.6 m (a shirt over a range of
# motion) cameras stand 1.5 m away; the low ring looks down at the legs and the upper one up at the head.
RINGS: tuple[tuple[str, float, float, float, float], ...] = (
    ("low", 0.25, 2.47, -1.30, -0.30),
    ("middle", 0.35, 2.47, 0.0, 0.0),
    ("upper", 0.25, 2.33, 1.30, 0.18),
    ("top", 0.10, 1.55, 2.25, 0.0),
    ("floor", 0.05, 2.00, -1.50, 0.0),
)


def look_at(eye: Point, target: Point) -> Float64[np.ndarray, "4 4"]:
    """T_camera_world of a camera at `eye`, its z axis towards `target`, world Y up in its image."""
    eye, target = np.asarray(eye, float), np.asarray(target, float)
    forward = target - eye
    right = np.cross(forward, (0.0, 1.0, 0.0))
    if not np.linalg.norm(right) > 1e-9 * np.linalg.norm(forward):
        raise InputError(f"look_at: a vertical view has no upright image, found eye {eye} and target {target}")
    forward /= np.linalg.norm(forward)
    right /= np.linalg.norm(right)
    transform = np.eye(4)
    transform[:3, :3] = right, np.cross(forward, right), forward
    transform[:3, 3] = -transform[:3, :3] @ eye
    return transform


def bounding_sphere(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre (3,) of the bounding box of points (..., 3) and the radius, metres, of the sphere about it."""
    points = np.asarray(points, float).reshape(-1, 3)
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    return centre, float(np.linalg.norm(points - centre, axis=1).max())


def capture_rig(
    *,
    centre: Point = (0.0, 1.2, 0.0),
    radius: float = 0.55,
    cameras: int = 48,
    image_size: int = 512,
    field_of_view_deg: float = 48.0,
) -> Rig:
    """Cameras in rings around a subject, all sharp, undistorted and equal.

    Args:
        centre, radius: sphere around what is to be captured, metres; `bounding_sphere` finds it. The default is the
            upper body of a standing adult.
        image_size: width and height, pixels.
    """
    if cameras < 4:
        raise InputError(f"cameras: expected at least 4, found {cameras}")
    if not radius > 0:
        raise InputError(f"radius: expected a positive length in metres, found {radius}")
    centre = np.asarray(centre, float)
    names, transforms = [], []
    for index, (ring, count) in enumerate(zip(RINGS, _ring_counts(cameras), strict=True)):
        name, _, distance, height, aim = ring
        azimuths = 2 * np.pi * (np.arange(count) / max(count, 1) + 0.381966 * index)
        for number, azimuth in enumerate(azimuths):
            offset = np.array([distance * np.sin(azimuth), height, distance * np.cos(azimuth)])
            transforms.append(look_at(centre + radius * offset, centre + radius * np.array([0.0, aim, 0.0])))
            names.append(f"{name}{number:02d}")
    focal = image_size / 2 / np.tan(np.radians(field_of_view_deg) / 2)
    middle = (image_size - 1) / 2
    intrinsics = np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1]])
    return Rig(
        names=tuple(names),
        intrinsics=np.tile(intrinsics, (cameras, 1, 1)),
        distortion=np.zeros((cameras, 5)),
        T_camera_world=np.stack(transforms),
        image_sizes=np.full((cameras, 2), image_size, np.int32),
    )


def pod_rig(*, centre: Point, radius: float, config: StereoConfig) -> Rig:
    """Pairs of parallel cameras, left and right in turn, around a subject.

    A pod's principal points are shifted so that both its cameras see the same square at the distance of the subject:
    there the disparity is zero. Rows correspond: the pairs are rectified as they are.

    Args:
        centre, radius: sphere around what is to be captured, metres.
    """
    pods = capture_rig(
        centre=centre,
        radius=radius,
        cameras=config.pods,
        image_size=config.image_size,
        field_of_view_deg=config.field_of_view_deg,
    )
    distance = np.linalg.norm(pods.centres - np.asarray(centre, float), axis=1)
    sides = np.tile([-0.5, 0.5], config.pods) * config.baseline_m
    intrinsics, transforms = np.repeat(pods.intrinsics, 2, axis=0), np.repeat(pods.T_camera_world, 2, axis=0)
    transforms[:, 0, 3] -= sides
    intrinsics[:, 0, 2] += intrinsics[:, 0, 0] * sides / np.repeat(distance, 2)
    return Rig(
        names=tuple(f"{name}_{side}" for name in pods.names for side in ("left", "right")),
        intrinsics=intrinsics,
        distortion=np.zeros((2 * config.pods, 5)),
        T_camera_world=transforms,
        image_sizes=np.repeat(pods.image_sizes, 2, axis=0),
    )


def scanner_rig(config: ScannerConfig, *, centre: Point, radius: float) -> Rig:
    """The rig of a scanner around a sphere, metres: depth cameras or stereo pods."""
    if config.sensor == "stereo":
        return pod_rig(centre=centre, radius=radius, config=config.stereo)
    rig = config.rig
    return capture_rig(
        centre=centre,
        radius=radius,
        cameras=rig.cameras,
        image_size=rig.image_size,
        field_of_view_deg=rig.field_of_view_deg,
    )


def _ring_counts(cameras: int) -> list[int]:
    """Whole cameras per ring, by largest remainder."""
    exact = np.array([share * cameras for _, share, *_ in RINGS])
    counts = np.floor(exact).astype(int)
    counts[np.argsort(counts - exact, kind="stable")[: cameras - counts.sum()]] += 1
    return counts.tolist()
