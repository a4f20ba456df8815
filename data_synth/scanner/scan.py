"""The virtual 4D scanner: surfaces in, one noisy, holey, coloured mesh out, as a capture stage would deliver it.

Every camera sees depth and colour by ray casting (`raycast`), its sensor adds correlated noise and loses pixels
(`depth_noise`), and the images are fused into a mesh (`fusion`). Holes are not drawn: they are where fewer than two
cameras see the surface. The stereo scanner matches pairs of images under a speckle pattern instead (`stereo`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import UInt8
from scipy.spatial import KDTree

from capture4d.errors import InputError
from capture4d.geometry.mesh import face_areas
from capture4d.types import Mesh, Rig, Scan
from data_synth.scanner.config import ScannerConfig
from data_synth.scanner.depth_noise import corrupt_depth, draw_noise_fields
from data_synth.scanner.fusion import DepthFusion
from data_synth.scanner.lighting import flicker, light
from data_synth.scanner.raycast import NOTHING, Surface, SurfaceScene, nearest_surface
from data_synth.scanner.stereo import match_pair, speckle_pair

__all__ = ["LABEL_BODY", "LABEL_BORDER", "LABEL_GARMENT", "Surface", "scan_surfaces"]

LABEL_BODY, LABEL_GARMENT, LABEL_BORDER = 0, 1, 2
BACKDROP = np.float32(0.05)
"""Of the room, as the colour cameras see it."""


def scan_surfaces(
    rig: Rig,
    surfaces: Sequence[Surface],
    *,
    config: ScannerConfig,
    rng: np.random.Generator,
    frame_id: int = 0,
    time_s: float = 0.0,
) -> tuple[Scan, UInt8[np.ndarray, " verts"]]:
    """Scan surfaces from every camera of a rig.

    A garment is an open sheet. Its back hides what is behind it; whether it is scanned too is a setting, and then the
    two sides are fused apart, so that the inside of a sleeve does not disturb its outside. (A garment given as two
    sheets closer together than the truncation does: give one of them.)

    Args:
        rng: the only source of randomness; the same state gives the same arrays, on any number of threads.

    Returns:
        The scan, and the true label of each of its vertices: 0 body, 1 garment, 2 painted border of the garment.
    """
    if np.any(rig.distortion) or "fisheye" in rig.lenses:
        raise InputError(
            "rig.distortion: the scanner needs undistorted cameras, found non-zero coefficients or fisheyes"
        )
    if not surfaces:
        raise InputError("surfaces: expected at least one, found none")
    if config.sensor == "stereo":
        return _scan_stereo(rig, surfaces, config, rng, frame_id, time_s)
    lit = partial(light, rig=rig, shading=config.shading)
    scene = SurfaceScene(surfaces, lit=lit, thickness_m=config.fusion.thickness_m)
    frame_gain = flicker(config.shading, rng)
    fields = draw_noise_fields(config.noise, rng, largest_image=int(rig.image_sizes.max()))
    sized = [(surface, _area(surface)) for surface in surfaces]
    volumes = [DepthFusion(surface.voxel_m, area, config=config.fusion) for surface, area in sized]
    sides = [(volumes, 1)]
    if config.fusion.inside:
        sides.append(([DepthFusion(surface.voxel_m, 0.1 * area, config=config.fusion) for surface, area in sized], -1))
    for camera in range(len(rig.names)):
        images = scene.view(rig, camera)
        if images is None:
            continue
        depth = corrupt_depth(images.depth, np.abs(images.cosine), fields, config=config.noise, rng=rng)
        colours = images.colours * np.float32(1 + config.shading.camera_gain * rng.standard_normal())
        colours *= frame_gain
        colours += np.float32(config.shading.pixel_noise) * fields.window(fields.colour, depth.shape, rng)
        K = rig.intrinsics[camera].copy()
        K[:2, 2] -= images.origin[::-1]
        for side, sign in sides:
            for index, volume in enumerate(side):
                here = (images.surface == index) & (sign * images.cosine > 0)
                volume.add(np.where(here, depth, np.float32(0)), colours, K, rig.T_camera_world[camera])
    parts = [part for side, _ in sides for part in zip(surfaces, side, strict=True)]
    return _merge(parts, frame_id, time_s)


def _scan_stereo(
    rig: Rig,
    surfaces: Sequence[Surface],
    config: ScannerConfig,
    rng: np.random.Generator,
    frame_id: int,
    time_s: float,
) -> tuple[Scan, UInt8[np.ndarray, " verts"]]:
    """Everything in one volume, for a matcher does not know what it sees; the left cameras bring the colours."""
    lit = SurfaceScene(surfaces, lit=partial(light, rig=rig, shading=config.shading))
    bare = SurfaceScene(surfaces)
    volume = DepthFusion(
        min(surface.voxel_m for surface in surfaces),
        sum(_area(surface) for surface in surfaces),
        config=replace(config.fusion, min_weight=config.stereo.min_weight),
    )
    frame_gain = flicker(config.shading, rng)
    for left in range(0, len(rig.names), 2):
        pair = speckle_pair(bare, rig, left, config=config.stereo, rng=rng)
        gain = 1 + config.shading.camera_gain * rng.standard_normal()
        noise = config.shading.pixel_noise * rng.standard_normal((*pair.left.shape, 3), dtype=np.float32)
        colours = np.full((*pair.left.shape, 3), BACKDROP, np.float32)
        images = lit.view(rig, left)
        if images is not None:
            rows, columns = images.window
            colours[rows, columns] = np.where((images.surface == NOTHING)[..., None], BACKDROP, images.colours)
        colours = (gain * colours * frame_gain + noise).astype(np.float32)
        depth = match_pair(pair, colours, config=config.stereo)
        volume.add(depth, colours, rig.intrinsics[left], rig.T_camera_world[left])
    mesh, colours = volume.extract()
    return Scan(mesh, colours, frame_id, time_s), _nearest_labels(surfaces, mesh.vertices)


def _area(surface: Surface) -> float:
    return float(face_areas(surface.mesh.vertices, surface.mesh.faces).sum())


def _merge(
    parts: Sequence[tuple[Surface, DepthFusion]], frame_id: int, time_s: float
) -> tuple[Scan, UInt8[np.ndarray, " verts"]]:
    vertices, faces, colours, labels, count = [], [], [], [], 0
    for surface, volume in parts:
        mesh, colour = volume.extract()
        vertices.append(mesh.vertices)
        faces.append(mesh.faces + np.int32(count))
        colours.append(colour)
        labels.append(_labels(surface, mesh.vertices))
        count += len(mesh.vertices)
    mesh = Mesh(np.concatenate(vertices), np.concatenate(faces))
    return Scan(mesh, np.concatenate(colours), frame_id, time_s), np.concatenate(labels)


def _nearest_labels(surfaces: Sequence[Surface], points: np.ndarray) -> UInt8[np.ndarray, " points"]:
    """The labels of the nearest surface."""
    nearest = nearest_surface([surface.mesh for surface in surfaces], points)
    labels = np.zeros(len(points), np.uint8)
    for index, surface in enumerate(surfaces):
        labels[nearest == index] = _labels(surface, points[nearest == index])
    return labels


def _labels(surface: Surface, points: np.ndarray) -> UInt8[np.ndarray, " points"]:
    """Body, garment, or border where the nearest vertex of the garment is painted."""
    painted = surface.painted
    if surface.label != LABEL_GARMENT or painted is None or not painted.any() or not len(points):
        return np.full(len(points), surface.label, np.uint8)
    _, nearest = KDTree(surface.mesh.vertices).query(points, workers=1)
    return np.where(painted[nearest], LABEL_BORDER, LABEL_GARMENT).astype(np.uint8)
