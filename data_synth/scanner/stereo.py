"""Active stereo: what a pod's two cameras see of a projected speckle pattern, and the depth that a matcher finds in it.

The projector stands between the cameras. Its light obeys Lambert's law, falls off with the square of the distance, and
does not reach what lies in its shadow. Images are blurred, noisy and 8 bit; pairs are matched by semi-global matching
with its usual faults: silhouettes grow, wrong matches fly about, and where the pattern does not reach there is a hole.
Its preference for whole pixels is taken back by a refinement on the intensities (`disparity_refinement`).

References: Hirschmueller, Stereo processing by semiglobal matching and mutual information (PAMI 2008); OpenCV's
StereoSGBM.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from capture4d.colours.spaces import nearly_linear
from capture4d.types import Rig
from data_synth.scanner.config import StereoConfig
from data_synth.scanner.depth_noise import periodic_gaussian_field, silhouettes
from data_synth.scanner.disparity_refinement import refine_disparity
from data_synth.scanner.raycast import CameraImages, SurfaceScene

__all__ = ["SpecklePair", "match_pair", "speckle_pair"]

PATTERN_SIZE = 1024
"""Pixels along the side of the pattern, which repeats."""
EXPOSURE = 0.6
"""Of full scale, for the brightest hundredth of the subject."""
BACKDROP = 0.006
"""Light from the room, relative to the projector's, head-on at the pod's target."""
NEAREST, FARTHEST = 0.58, 1.42
"""Depths that are searched, relative to that of the pod's target; the rig's spheres end at 0.6 and 1.4."""


@dataclass(frozen=True, slots=True, eq=False)
class SpecklePair:
    """Rectified images of one pod."""

    left: UInt8[np.ndarray, "h w"]
    right: UInt8[np.ndarray, "h w"]
    focal_px: float
    baseline_m: float
    target_m: float
    """Depth at which the disparity is zero."""


def speckle_pair(
    scene: SurfaceScene, rig: Rig, left: int, *, config: StereoConfig, rng: np.random.Generator
) -> SpecklePair:
    """The images of the pod whose cameras are `left` and `left + 1` of a rig made by `pod_rig`.

    Args:
        scene: unlit surfaces; their colours are taken for albedo.
    """
    K = rig.intrinsics[left]
    eyes = rig.centres[left : left + 2]
    baseline = float(np.linalg.norm(eyes[1] - eyes[0]))
    target = float(K[0, 0] * baseline / (rig.intrinsics[left + 1, 0, 2] - K[0, 2]))
    images = []
    for camera, side in ((left, 0.5), (left + 1, -0.5)):
        radiance = _radiance(scene, rig, camera, eyes.mean(axis=0), side * baseline, target, config)
        images.append(_exposed(radiance, config, rng))
    return SpecklePair(images[0], images[1], float(K[0, 0]), baseline, target)


def _radiance(
    scene: SurfaceScene,
    rig: Rig,
    camera: int,
    projector: np.ndarray,
    projector_x: float,
    target: float,
    config: StereoConfig,
) -> Float32[np.ndarray, "h w"]:
    """What reaches the lens: the pattern on the surfaces. `projector_x` is the projector's place in camera axes."""
    width, height = (int(size) for size in rig.image_sizes[camera])
    radiance = np.full((height, width), BACKDROP, np.float32)
    factor = config.supersampling
    view = scene.view(_magnified(rig, camera, factor), 0)
    if view is None:
        return radiance
    fine = cv2.resize(radiance, (width * factor, height * factor))
    K, T = rig.intrinsics[camera], rig.T_camera_world[camera]
    top, start = view.origin
    v, u = ((index + 0.5) / factor - 0.5 for index in _pixel_grid(view.depth.shape))
    x = (u + start / factor - K[0, 2]) / K[0, 0]
    y = (v + top / factor - K[1, 2]) / K[1, 1]
    seen = view.depth > 0
    depth = np.where(seen, view.depth, np.float32(target))
    points = (np.stack([x, y, np.ones_like(x)], axis=-1) * depth[..., None])[seen]
    world = ((points - T[:3, 3]) @ T[:3, :3]).astype(np.float32)
    towards = np.linalg.norm(points - [projector_x, 0, 0], axis=1)
    lambert = scene.incidence(world, projector.astype(np.float32))
    pattern = _pattern_at(x - projector_x / depth, y, float(K[0, 0]), config.speckle_px)[seen]
    albedo = _albedo(view)[seen]
    lit = albedo * (pattern * lambert * (target / towards) ** 2 + config.ambient)
    window = fine[view.window]
    window[seen] = lit
    return cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA)


def _pixel_grid(shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of every pixel, float32."""
    rows, columns = np.indices((shape[0], shape[1])).astype(np.float32)
    return rows, columns


def _magnified(rig: Rig, camera: int, factor: int) -> Rig:
    """One camera of a rig with so many times the pixels."""
    K = rig.intrinsics[camera] * np.array([[factor], [factor], [1]])
    K[:2, 2] += (factor - 1) / 2
    return Rig(
        names=(rig.names[camera],),
        intrinsics=K[None],
        distortion=rig.distortion[camera : camera + 1],
        T_camera_world=rig.T_camera_world[camera : camera + 1],
        image_sizes=(rig.image_sizes[camera : camera + 1] * factor).astype(np.int32),
    )


def _albedo(view: CameraImages) -> Float32[np.ndarray, "h w"]:
    """Grey of the colours in linear light."""
    return nearly_linear(view.colours) @ np.array([0.3, 0.5, 0.2], np.float32)


@cache
def _pattern(speckle_px: float) -> Float32[np.ndarray, "size size"]:
    """Bright speckles on a dark ground, seamless, the same in every projector."""
    field = periodic_gaussian_field(PATTERN_SIZE, speckle_px, np.random.default_rng(0))
    return np.clip(0.5 + 1.4 * field, 0, 1).astype(np.float32)


def _pattern_at(x: np.ndarray, y: np.ndarray, focal_px: float, speckle_px: float) -> Float32[np.ndarray, "h w"]:
    """The projector's light in directions (x, y, 1); one of its pixels is one of the cameras'."""
    columns, rows = (np.mod(focal_px * direction, PATTERN_SIZE).astype(np.float32) for direction in (x, y))
    return cv2.remap(_pattern(speckle_px), columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)


def _exposed(radiance: np.ndarray, config: StereoConfig, rng: np.random.Generator) -> UInt8[np.ndarray, "h w"]:
    blurred = cv2.GaussianBlur(radiance, (0, 0), config.blur_px) if config.blur_px > 0 else radiance
    subject = blurred[blurred > 2 * BACKDROP]
    white = float(np.percentile(subject, 99)) / EXPOSURE if len(subject) else 1.0
    electrons = np.clip(blurred / white, 0, 1) * config.full_well
    spread = np.sqrt(electrons + config.read_noise**2)
    noisy = electrons + spread * rng.standard_normal(electrons.shape, dtype=np.float32)
    return np.clip(np.rint(255 / config.full_well * noisy), 0, 255).astype(np.uint8)


def match_pair(
    pair: SpecklePair, colours: Float32[np.ndarray, "h w 3"], *, config: StereoConfig
) -> Float32[np.ndarray, "h w"]:
    """Depth in the left camera, metres, cleaned; 0 where nothing is matched.

    Args:
        colours: of the left camera under white light, 1 = full scale; they guide the refinement of the matches.
    """
    scale = pair.focal_px * pair.baseline_m
    lowest, highest = (scale * (1 / (share * pair.target_m) - 1 / pair.target_m) for share in (FARTHEST, NEAREST))
    first = int(np.floor(lowest))
    count = -(-int(np.ceil(highest) - first) // 16) * 16
    matcher = cv2.StereoSGBM.create(
        minDisparity=first,
        numDisparities=count,
        blockSize=config.block_px,
        P1=8 * config.block_px**2,
        P2=32 * config.block_px**2,
        disp12MaxDiff=1,
        uniquenessRatio=config.uniqueness_percent,
        speckleWindowSize=config.speckle_window_px,
        speckleRange=2,
        mode=cv2.StereoSGBM_MODE_SGBM_3WAY,
    )
    before, after = max(first + count, 0), max(-first, 0)
    wide = [cv2.copyMakeBorder(image, 0, 0, before, after, cv2.BORDER_REFLECT) for image in (pair.left, pair.right)]
    found = matcher.compute(wide[0], wide[1])[:, before : before + pair.left.shape[1]]
    matched = found > 16 * first
    disparity = np.where(matched, found.astype(np.float32) / 16, np.float32(0))
    disparity = refine_disparity(disparity, matched, pair.left, pair.right, colours, steps=config.refinement_steps)
    bright = cv2.blur(pair.left, (5, 5)) > 255 * config.lost_intensity
    depth = scale / (disparity + scale / pair.target_m)
    return _cleaned(np.where(matched & bright, depth, 0).astype(np.float32), config.step_m)


def _cleaned(depth: np.ndarray, step_m: float) -> Float32[np.ndarray, "h w"]:
    """Median, then without the pixels at steps of depth, where silhouettes have grown."""
    if step_m <= 0:
        return depth
    smooth = cv2.medianBlur(depth, 5)
    edge = silhouettes(smooth, step_m)
    return np.where((depth > 0) & (smooth > 0) & ~edge, smooth, np.float32(0))
