"""How far results are from the truth: one definition of each measure, for the report and the benchmarks alike.

Everything here takes and returns arrays in metres and degrees; whoever prints them converts.

    truth distance        registered surface to the noise-free surface, and back
    correspondence error  registered vertex to the true place of the same material point
    drift                 change of the correspondence error over the frames
    border error          the template's border to the true border curve, and back
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32, Integer

from capture4d.geometry.ray_casting import surface_distances
from capture4d.types import Mesh

__all__ = [
    "border_errors",
    "correspondence_errors",
    "curve_distances",
    "drift_per_frame",
    "drift_ratio",
    "material_points",
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
