"""Pictures of meshes by ray casting: smooth shading, vertex colours or heat maps, no graphics driver needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Float32, UInt8

from capture4d.mesh import vertex_normals
from capture4d.open3d_loading import import_open3d
from capture4d.types import Mesh

__all__ = ["Direction", "Drawn", "View", "frame_view", "heat_colours", "render"]

Direction = Literal["front", "back", "left", "right", "three_quarter", "three_quarter_back"]
AZIMUTH_DEG: dict[Direction, float] = {
    "front": 0.0,
    "three_quarter": 35.0,
    "left": 90.0,
    "three_quarter_back": 145.0,
    "back": 180.0,
    "right": 270.0,
}
"""Angle of the camera about the Y axis: 0 looks at the subject's face (from +Z), 90 at the subject's left (from +X)."""

NO_DATA = (178, 178, 178)
# Key, fill and rim light in the camera's axes (x right, y up, z towards the viewer), and their strengths.
LIGHTS = np.array([[-0.45, 0.65, 0.62], [0.75, 0.05, 0.66], [0.0, -0.35, 0.25]])
STRENGTHS = np.array([0.72, 0.22, 0.10])
AMBIENT = 0.16


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """A mesh and how it is painted."""

    mesh: Mesh
    colours: UInt8[np.ndarray, "verts 3"] | tuple[int, int, int] = (200, 198, 194)
    """sRGB, per vertex or one for all."""


@dataclass(frozen=True, slots=True)
class View:
    """A camera: what it looks at, from where, and how much fits into the height of the picture."""

    target: tuple[float, float, float]
    azimuth_deg: float
    elevation_deg: float
    height_m: float
    """Height of the plane through `target` that the picture shows."""
    distance_m: float | None = None
    """From `target` to the eye; None is an orthographic view."""

    def axes(self) -> Float[np.ndarray, "3 3"]:
        """Rows: right, up and backward (towards the viewer) in the world."""
        azimuth, elevation = np.radians([self.azimuth_deg, self.elevation_deg])
        sin_a, cos_a, sin_e, cos_e = np.sin(azimuth), np.cos(azimuth), np.sin(elevation), np.cos(elevation)
        right = (cos_a, 0.0, -sin_a)
        up = (-sin_a * sin_e, cos_e, -cos_a * sin_e)
        backward = (sin_a * cos_e, sin_e, cos_a * cos_e)
        return np.array([right, up, backward])


def frame_view(
    lower: tuple[float, float, float] | np.ndarray,
    upper: tuple[float, float, float] | np.ndarray,
    direction: Direction = "front",
    *,
    elevation_deg: float = 8.0,
    aspect: float = 0.75,
    margin: float = 0.06,
    perspective: bool = True,
) -> View:
    """The view that shows a whole box.

    Args:
        lower, upper: corners of the box, metres. Use one box for all frames of a take, so that the camera rests.
        aspect: width over height of the picture.
    """
    lower, upper = np.asarray(lower, float), np.asarray(upper, float)
    centre = (lower + upper) / 2
    view = View(tuple(centre.tolist()), AZIMUTH_DEG[direction], elevation_deg, 1.0)
    corners = np.array(np.meshgrid(*zip(lower, upper, strict=True))).reshape(3, -1).T - centre
    x, y, z = np.abs(corners @ view.axes().T).max(axis=0)
    height = 2 * max(y, x / aspect, 1e-6) * (1 + margin)
    distance = 3 * height + z if perspective else None
    if distance is not None:  # the nearer half of the box looks larger
        height *= distance / (distance - z)
    return View(view.target, view.azimuth_deg, elevation_deg, float(height), distance)


def heat_colours(
    values: Float[np.ndarray, " verts"], *, low: float = 0.0, high: float, colormap: str = "viridis"
) -> UInt8[np.ndarray, "verts 3"]:
    """Colours of scalars between `low` and `high`, which saturate; NaN, no data, is grey."""
    import matplotlib

    share = (np.asarray(values, float) - low) / (high - low)
    table = (matplotlib.colormaps[colormap](np.linspace(0, 1, 256))[:, :3] * 255 + 0.5).astype(np.uint8)
    missing = np.isnan(share)
    index = np.clip(np.where(missing, 0, share) * 255 + 0.5, 0, 255).astype(np.uint8)
    colours = table[index]
    colours[missing] = NO_DATA
    return colours


def render(
    drawn: Sequence[Drawn],
    view: View,
    *,
    width: int = 480,
    height: int = 640,
    background: tuple[int, int, int] = (255, 255, 255),
    supersampling: int = 2,
) -> UInt8[np.ndarray, "height width 3"]:
    """A picture of meshes, row 0 on top."""
    o3d = import_open3d()
    scene = o3d.t.geometry.RaycastingScene()
    colours, normals, faces, counts = [], [], [], [0]
    for item in drawn:
        mesh = item.mesh
        if not len(mesh.faces):
            continue
        scene.add_triangles(o3d.core.Tensor(mesh.vertices), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
        colours.append(np.broadcast_to(_linear(np.asarray(item.colours, np.uint8)), mesh.vertices.shape))
        normals.append(vertex_normals(mesh.vertices, mesh.faces))
        faces.append(mesh.faces + sum(len(each) for each in colours[:-1]))
        counts.append(counts[-1] + len(mesh.faces))
    samples = (height * supersampling, width * supersampling)
    backdrop = _linear(np.array(background, np.uint8))
    picture = np.tile(backdrop, (samples[0] * samples[1], 1))
    if faces:
        rays = _rays(view, *samples)
        answer = scene.cast_rays(o3d.core.Tensor(rays))
        hit = np.flatnonzero(np.isfinite(answer["t_hit"].numpy()))
        face = answer["primitive_ids"].numpy()[hit] + np.array(counts)[answer["geometry_ids"].numpy()[hit]]
        corners, weights = np.concatenate(faces)[face], _barycentric(answer["primitive_uvs"].numpy()[hit])
        colour = np.einsum("nk,nkc->nc", weights, np.concatenate(colours)[corners])
        normal = np.einsum("nk,nkc->nc", weights, np.concatenate(normals)[corners])
        picture[hit] = colour * _shade(normal, rays[hit, 3:], view)[:, None]
    picture = picture.reshape(height, supersampling, width, supersampling, 3).mean(axis=(1, 3))
    return _encoded(picture)


def _rays(view: View, rows: int, columns: int) -> Float32[np.ndarray, "rays 6"]:
    """One ray through the centre of every pixel, row by row from the top."""
    right, up, backward = view.axes()
    pixel = view.height_m / rows
    x = (np.arange(columns) + 0.5 - columns / 2) * pixel
    y = (rows / 2 - np.arange(rows) - 0.5) * pixel
    on_plane = np.array(view.target) + y[:, None, None] * up + x[:, None] * right
    if view.distance_m is None:
        directions = np.broadcast_to(-backward, on_plane.shape)
        origins = on_plane + 10 * view.height_m * backward
    else:
        origins = np.broadcast_to(np.array(view.target) + view.distance_m * backward, on_plane.shape)
        directions = on_plane - origins
    return np.concatenate([origins, directions], axis=2, dtype=np.float32).reshape(-1, 6)


def _shade(normals: np.ndarray, directions: np.ndarray, view: View) -> np.ndarray:
    """Light that reaches the eye, Lambert; sheets are lit on both sides, their backs dimmer."""
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    facing = -np.einsum("ij,ij->i", normals, directions)
    normals = np.where(facing[:, None] < 0, -normals, normals)
    lights = LIGHTS / np.linalg.norm(LIGHTS, axis=1, keepdims=True) @ view.axes()
    light = AMBIENT + np.clip(normals @ lights.T, 0, None) @ STRENGTHS
    return np.where(facing < 0, 0.6, 1.0) * light


def _barycentric(uv: np.ndarray) -> np.ndarray:
    return np.column_stack([1 - uv.sum(axis=1), uv])


def _linear(srgb: np.ndarray) -> np.ndarray:
    """Light of an 8-bit sRGB colour (a power of 2.2 is close enough for pictures)."""
    return (srgb.astype(np.float32) / 255) ** 2.2


def _encoded(light: np.ndarray) -> Any:
    return (np.clip(light, 0, 1) ** (1 / 2.2) * 255 + 0.5).astype(np.uint8)
