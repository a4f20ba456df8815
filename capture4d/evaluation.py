"""How far results are from the truth: one definition of each measure, for the report and the benchmarks alike.

Everything here takes and returns arrays in metres and degrees; whoever prints them converts.

    truth distance        registered surface to the noise-free surface, and back
    correspondence error  registered vertex to the true place of the same material point
    drift                 change of the correspondence error over the frames
    border error          the template's border to the true border curve, and back
    scan accuracy, normal error, holes    a scan against the surface it was made from
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32, Integer
from scipy.spatial import KDTree

from capture4d.geometry.closest_points import closest_points, surface_distances
from capture4d.geometry.mesh import face_areas, vertex_normals
from capture4d.types import Mesh

__all__ = [
    "ScanErrors",
    "border_errors",
    "correspondence_errors",
    "curve_distances",
    "drift_per_frame",
    "drift_ratio",
    "material_points",
    "scan_errors",
    "truth_distances",
]


def truth_distances(
    registered: Mesh, truth: Mesh, *, covered: Bool[np.ndarray, " verts"] | None = None
) -> tuple[Float64[np.ndarray, " kept"], Float64[np.ndarray, " fine"]]:
    """Registered vertices to the true surface, and true vertices to the registered surface, metres.

    Args:
        covered: registered vertices that have scan data; the others are left out of the first result.
    """
    vertices = registered.vertices if covered is None else registered.vertices[covered]
    return surface_distances(truth, vertices), surface_distances(registered, truth.vertices)


def material_points(
    vertices: Float32[np.ndarray, "fine 3"],
    faces: Integer[np.ndarray, "faces 3"],
    map_faces: Int32[np.ndarray, " verts"],
    map_barycentric: Float32[np.ndarray, "verts 3"],
) -> Float32[np.ndarray, "verts 3"]:
    """Where the material points of a template truly are: barycentric points of the fine surface."""
    return np.einsum("vc,vcx->vx", map_barycentric, vertices[faces[map_faces]]).astype(np.float32)


def correspondence_errors(
    vertices: Float[np.ndarray, "verts 3"], truth: Float[np.ndarray, "verts 3"]
) -> Float64[np.ndarray, " verts"]:
    """Registered vertices to the true places of the same material points, metres."""
    return np.linalg.norm(vertices.astype(float) - truth, axis=1)


def drift_per_frame(values: Float[np.ndarray, " frames"]) -> float:
    """Slope of the least-squares line through per-frame errors, in their unit per frame; 0 for a single frame."""
    frames = np.arange(len(values)) - (len(values) - 1) / 2
    return float(frames @ values / (frames @ frames)) if len(values) > 1 else 0.0


def drift_ratio(values: Float[np.ndarray, " frames"], *, window: int = 20) -> float:
    """Mean of the last `window` per-frame errors over the mean of the first; shorter takes are halved."""
    window = max(1, min(window, len(values) // 2))
    return float(np.mean(values[-window:]) / np.mean(values[:window]))


def curve_distances(
    points: Float[np.ndarray, "points 3"], curve: Float[np.ndarray, "verts 3"]
) -> Float64[np.ndarray, " points"]:
    """Distance of points to a closed polyline, metres. Exact."""
    start = curve.astype(float)
    along = np.roll(start, -1, axis=0) - start
    squared = np.maximum(np.einsum("sx,sx->s", along, along), 1e-30)
    result = np.empty(len(points))
    for chunk in np.array_split(np.arange(len(points)), len(points) * len(start) // 1_000_000 + 1):
        offset = points[chunk, None].astype(float) - start
        share = np.clip(np.einsum("psx,sx->ps", offset, along) / squared, 0, 1)
        offset -= share[..., None] * along
        result[chunk] = np.sqrt(np.einsum("psx,psx->ps", offset, offset).min(axis=1))
    return result


def border_errors(
    found: Mapping[str, Float[np.ndarray, "_ 3"]], truth: Mapping[str, Float[np.ndarray, "_ 3"]]
) -> Float64[np.ndarray, " both"]:
    """Border vertices to the true border curve of the same name, and the true border's vertices back, metres."""
    errors = [np.zeros(0)]
    for name, curve in truth.items():
        if name in found:
            errors += [curve_distances(found[name], curve), curve_distances(curve, found[name])]
    return np.concatenate(errors)


@dataclass(frozen=True, slots=True, eq=False)
class ScanErrors:
    """A scan of a sheet against the sheet."""

    distance_m: Float64[np.ndarray, " verts"]
    """Scan vertex to the true surface."""
    normal_deg: Float64[np.ndarray, " verts"]
    """Angle between the scan's and the true normal, of the side that was scanned."""
    hole_share: float
    """Part of the true area that has no scan vertex within the gate."""


def scan_errors(scan: Mesh, truth: Mesh, *, hole_gate_m: float = 0.004, samples: int = 50_000) -> ScanErrors:
    """Measure the scan of an open sheet, which may show either side of it.

    Args:
        scan: the part of the scan that shows the sheet, without a change of its own borders.
        hole_gate_m: farther than this from every scan vertex, the true surface counts as not scanned.
    """
    points, faces, barycentric = closest_points(truth, scan.vertices)
    normals = vertex_normals(truth.vertices, truth.faces)
    expected = np.einsum("vc,vcx->vx", barycentric, normals[truth.faces[faces]])
    expected /= np.maximum(np.linalg.norm(expected, axis=1, keepdims=True), 1e-12)
    cosine = np.einsum("vx,vx->v", vertex_normals(scan.vertices, scan.faces), expected)
    areas = face_areas(truth.vertices, truth.faces).astype(float)
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(areas), samples, p=areas / areas.sum())
    weights = rng.dirichlet((1, 1, 1), samples)
    on_truth = np.einsum("vc,vcx->vx", weights, truth.vertices[truth.faces[chosen]])
    nearest, _ = KDTree(scan.vertices).query(on_truth)
    return ScanErrors(
        distance_m=np.linalg.norm(points.astype(float) - scan.vertices, axis=1),
        normal_deg=np.degrees(np.arccos(np.clip(np.abs(cosine.astype(float)), 0, 1))),
        hole_share=float((nearest > hole_gate_m).mean()),
    )
