"""High-resolution normals: what a scan says about the surface under every texel of the template.

From each texel's surface point a ray along the interpolated normal and one against it look for the scan; where neither
meets it within the gates, the nearest point of the scan may answer. Texels without an answer are "no information".

A single scan is noisy. Its normals are expressed in the template's tangent frames, where they hardly change from frame
to frame, averaged over neighbouring frames and blurred by half a texel; the gates and these two decide whether
wrinkles survive. DeepWrinkles (ECCV 2018), section 3.3 and Fig. 6; the paper does not say how it projects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from capture4d.errors import InputError
from capture4d.geometry.mesh import normalised
from capture4d.geometry.mesh_kernels import laplacian_pass, open_vertices, vertex_normals_kernel
from capture4d.geometry.ray_casting import TriangleScene, barycentric
from capture4d.geometry.uv_raster import UvRaster
from capture4d.types import Mesh
from wrinkles.normal_maps.config import ProjectionConfig

__all__ = ["TexelNormals", "combine_frames", "project_scan"]


@dataclass(frozen=True, slots=True, eq=False)
class TexelNormals:
    """Unit normals at the texels of a raster, and where they are known."""

    normals: Float32[np.ndarray, "N 3"]
    """Zero where unknown."""
    valid: Bool[np.ndarray, " N"]


def project_scan(
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
    scan: Mesh,
    config: ProjectionConfig,
) -> TexelNormals:
    """The scan's normals at the template's texels, in world coordinates.

    Args:
        points: surface points of the texels, metres.
        normals: unit normals of the template there, outwards.
        scan: the garment alone.
    Raises:
        InputError: the scan has no faces.
    """
    if not len(scan.faces):
        raise InputError("scan: expected a garment with faces, found none")
    scan_normals, trusted = _scan_surface(scan, config)
    scene = TriangleScene((scan.vertices, scan.faces))
    points, normals = points.astype(np.float32), normals.astype(np.float32)
    gate = float(np.cos(np.radians(config.angle_deg)))

    found = np.zeros_like(normals)
    valid = np.zeros(len(points), bool)
    nearest = np.full(len(points), np.inf, np.float32)

    def accept(index: np.ndarray, distance: np.ndarray, face: np.ndarray, uv: np.ndarray) -> None:
        """Take answers that are near enough, face the same way, lie on trusted faces, and beat an earlier one."""
        near = (distance <= config.distance_m) & (distance < nearest[index])
        index, distance, face, uv = index[near], distance[near], face[near], uv[near]
        normal = normalised(np.einsum("nk,nkc->nc", barycentric(uv), scan_normals[scan.faces[face]]))
        good = (np.einsum("nc,nc->n", normal, normals[index]) >= gate) & trusted[face]
        index = index[good]
        found[index], valid[index], nearest[index] = normal[good], True, distance[good]

    everything = np.arange(len(points))
    for direction in (normals, -normals):
        met = scene.cast(np.concatenate([points, direction], axis=1))
        hit = np.flatnonzero(np.isfinite(met.distance))
        accept(hit, met.distance[hit], met.faces[hit], met.uv[hit])
    missing = everything[~valid]
    if len(missing):
        found_near = scene.nearest(points[missing])
        distance = np.linalg.norm(found_near.points - points[missing], axis=1)
        accept(missing, distance, found_near.faces, found_near.uv)
    return TexelNormals(found, valid)


def combine_frames(
    frames: Sequence[tuple[TexelNormals, Float64[np.ndarray, "N 3 3"]]],
    centre: int,
    raster: UvRaster,
    config: ProjectionConfig,
) -> TexelNormals:
    """The normals of frame `centre`, calmed by its neighbours and a blur.

    Args:
        frames: neighbouring frames with the template's tangent frames in each (rows tangent, bitangent, normal).
    Returns:
        World normals in frame `centre`, valid where that frame itself is.
    """
    own, basis = frames[centre]
    total = np.zeros((len(own.valid), 3))
    for normals, frame in frames:
        total += np.einsum("nrc,nc->nr", frame, normals.normals) * normals.valid[:, None]
    local = normalised(total)
    if config.blur_texels > 0:
        local = _masked_blur(local, own.valid, raster, config.blur_texels)
    world = np.einsum("nrc,nr->nc", basis, normalised(local))
    return TexelNormals((world * own.valid[:, None]).astype(np.float32), own.valid)


def _scan_surface(scan: Mesh, config: ProjectionConfig) -> tuple[np.ndarray, np.ndarray]:
    """Smoothed vertex normals, and which faces are not next to an open border."""
    normals: Any = vertex_normals_kernel(scan.vertices.astype(np.float64), scan.faces)
    none = np.zeros(len(scan.vertices), bool)
    for _ in range(config.smoothing_passes):
        normals = laplacian_pass(normals, scan.faces, none)
    outer = open_vertices(scan.faces, len(scan.vertices))[0]
    for _ in range(config.border_rings - 1):
        ring = outer.copy()
        ring[scan.faces[outer[scan.faces].any(axis=1)]] = True
        outer = ring
    trusted = ~outer[scan.faces].any(axis=1) if config.border_rings else np.ones(len(scan.faces), bool)
    return normalised(normals).astype(np.float32), trusted


def _masked_blur(values: np.ndarray, valid: np.ndarray, raster: UvRaster, sigma: float) -> np.ndarray:
    weight = raster.image(valid.astype(np.float32))
    image = raster.image((values * valid[:, None]).astype(np.float32))
    blurred = cv2.GaussianBlur(image, (0, 0), sigma)
    blurred_weight = cv2.GaussianBlur(weight, (0, 0), sigma)
    return raster.read(blurred) / np.maximum(raster.read(blurred_weight), 1e-6)[:, None]
