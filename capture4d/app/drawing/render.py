"""Pictures of meshes by ray casting: smooth shading, vertex colours or heat maps, no graphics driver needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Float32, Int, Int32, UInt8

from capture4d.colours.spaces import nearly_encoded, nearly_linear
from capture4d.geometry.mesh import vertex_normals
from capture4d.geometry.ray_casting import TriangleScene, barycentric
from capture4d.geometry.tangents import TangentLayout, interpolated_frames
from capture4d.geometry.uv_raster import sample_bilinear
from capture4d.types import Mesh

__all__ = ["BEYOND", "NO_DATA", "Direction", "Drawn", "Traced", "View", "frame_view", "heat_colours", "render", "trace"]

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

NO_DATA = (168, 172, 178)
BEYOND = (0, 176, 200)
"""Of values beyond the end of a scale: a hue that the scale does not have, so that clipped values stand out."""
# Matplotlib's perceptually uniform "magma" (CC0), from its light end: good values are pale, so that the shading of the
# folds stays visible.
HEAT = np.array(
    [
        (252, 253, 191),
        (253, 231, 169),
        (254, 207, 146),
        (254, 183, 126),
        (254, 159, 109),
        (252, 137, 97),
        (247, 112, 92),
        (237, 90, 95),
        (222, 73, 104),
        (202, 62, 114),
        (183, 55, 121),
        (161, 48, 126),
        (140, 41, 129),
        (120, 34, 129),
        (100, 26, 128),
        (81, 18, 124),
        (59, 15, 112),
        (37, 18, 85),
    ]
)
# Key, fill and rim light in the camera's axes (x right, y up, z towards the viewer), and their strengths.
LIGHTS = np.array([[-0.45, 0.65, 0.62], [0.75, 0.05, 0.66], [0.0, -0.35, 0.25]])
STRENGTHS = np.array([0.80, 0.26, 0.10])
AMBIENT = 0.20
SUPERSAMPLING = 2
"""Samples along each side of a pixel."""


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """A mesh and how it is painted."""

    mesh: Mesh
    colours: UInt8[np.ndarray, "verts 3"] | tuple[int, int, int] = (200, 198, 194)
    """sRGB, per vertex or one for all."""
    normal_map: Float32[np.ndarray, "size size 3"] | None = None
    """Tangent-space normals, OpenGL's +Y, row 0 at v = 1; needs UVs in the unit square."""


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


def heat_colours(values: Float[np.ndarray, " verts"], *, low: float = 0.0, high: float) -> UInt8[np.ndarray, "verts 3"]:
    """Colours of scalars: pale at `low`, through orange to dark violet at `high`; what is beyond is turquoise, and NaN,
    no data, grey."""
    place = (np.asarray(values, float) - low) / (high - low)
    share = np.clip(place, 0, 1)
    missing = np.isnan(share)
    position = np.where(missing, 0, share) * (len(HEAT) - 1)
    colours = np.stack([np.interp(position, np.arange(len(HEAT)), channel) for channel in HEAT.T], axis=-1)
    colours[place > 1] = BEYOND
    colours[missing] = NO_DATA
    return (colours + 0.5).astype(np.uint8)


def render(
    drawn: Sequence[Drawn],
    view: View,
    *,
    width: int = 480,
    height: int = 640,
    background: tuple[int, int, int] = (255, 255, 255),
) -> UInt8[np.ndarray, "height width 3"]:
    """A picture of meshes, row 0 on top."""
    maps = [item.normal_map for item in drawn]
    traced = trace([item.mesh for item in drawn], view, width=width, height=height, normal_maps=maps)
    return traced.painted([item.colours for item in drawn], background=background)


def trace(
    meshes: Sequence[Mesh],
    view: View,
    *,
    width: int,
    height: int,
    normal_maps: Sequence[Float32[np.ndarray, "size size 3"] | None] | None = None,
) -> Traced:
    """Find what every pixel sees, to be painted once or several times.

    Args:
        normal_maps: tangent-space normals for each mesh, or None for its own.
    """
    normals, faces, first_vertex, first_face = [np.zeros((0, 3))], [np.zeros((0, 3), np.int32)], 0, [0]
    for mesh in meshes:
        normals.append(vertex_normals(mesh.vertices, mesh.faces))
        faces.append(mesh.faces + np.int32(first_vertex))
        first_vertex += len(mesh.vertices)
        if len(mesh.faces):
            first_face.append(first_face[-1] + len(mesh.faces))
    counts = tuple(len(mesh.vertices) for mesh in meshes)
    if len(first_face) == 1:
        none = np.zeros((0, 3), np.float32)
        return Traced((height, width), counts, np.zeros(0, int), none.astype(np.int32), none, none[:, 0])
    rays = _rays(view, height * SUPERSAMPLING, width * SUPERSAMPLING)
    scene = TriangleScene(*((mesh.vertices, mesh.faces) for mesh in meshes if len(mesh.faces)), threads=0)
    hits = scene.cast(rays)
    hit = np.flatnonzero(np.isfinite(hits.distance))
    face = hits.faces[hit] + np.array(first_face)[hits.surfaces[hit]]
    corners = np.concatenate(faces)[face]
    weights = barycentric(hits.uv[hit])
    normal = np.einsum("nk,nkc->nc", weights, np.concatenate(normals)[corners])
    facing = -np.einsum("ij,ij->i", normal, rays[hit, 3:])
    first = 0
    for mesh, normal_map in zip(meshes, normal_maps or [None] * len(meshes), strict=True):
        if normal_map is not None:
            seen = (face >= first) & (face < first + len(mesh.faces))
            normal[seen] = _mapped(mesh, normal_map, face[seen] - first, weights[seen], normal[seen])
        first += len(mesh.faces)
    light = _shade(normal, facing < 0, view).astype(np.float32)
    return Traced((height, width), counts, hit, corners, weights, light)


@dataclass(frozen=True, slots=True, eq=False)
class Traced:
    """What the samples of a picture see, and how bright it is."""

    size: tuple[int, int]
    """Height and width of the picture."""
    counts: tuple[int, ...]
    """Vertices of each mesh."""
    hit: Int[np.ndarray, " hits"]
    """Samples that see a mesh, row by row."""
    corners: Int32[np.ndarray, "hits 3"]
    """Vertices of the face they see, all meshes counted through."""
    weights: Float32[np.ndarray, "hits 3"]
    light: Float32[np.ndarray, " hits"]

    def painted(
        self,
        colours: Sequence[UInt8[np.ndarray, "_ 3"] | tuple[int, int, int]],
        *,
        background: tuple[int, int, int] = (255, 255, 255),
    ) -> UInt8[np.ndarray, "height width 3"]:
        """The picture with these colours, one for each mesh or for each of its vertices."""
        height, width = self.size
        picture = np.tile(_linear(np.array(background, np.uint8)), (height * width * SUPERSAMPLING**2, 1))
        table = [
            np.broadcast_to(_linear(np.asarray(each, np.uint8)), (count, 3))
            for each, count in zip(colours, self.counts, strict=True)
        ]
        if len(self.hit):
            colour = np.einsum("nk,nkc->nc", self.weights, np.concatenate(table)[self.corners])
            picture[self.hit] = colour * self.light[:, None]
        samples = picture.reshape(height, SUPERSAMPLING, width, SUPERSAMPLING, 3)
        return _encoded(samples.mean(axis=(1, 3)))


def _mapped(
    mesh: Mesh, normal_map: np.ndarray, faces: np.ndarray, weights: np.ndarray, normals: np.ndarray
) -> np.ndarray:
    """World normals that a tangent-space map gives to points of a mesh."""
    if mesh.uv is None:
        raise ValueError("normal_map: expected a mesh with UVs")
    layout = TangentLayout(mesh.faces, mesh.uv)
    tangents = layout.tangents(mesh.vertices, vertex_normals(mesh.vertices.astype(float), mesh.faces))[faces]
    frames = interpolated_frames(normals, np.einsum("nk,nkc->nc", weights, tangents), layout.sign[faces])
    uv = np.einsum("nk,nkc->nc", weights, mesh.uv[faces])
    return np.einsum("nrc,nr->nc", frames, sample_bilinear(normal_map, uv))


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


def _shade(normals: np.ndarray, backs: np.ndarray, view: View) -> np.ndarray:
    """Light that reaches the eye, Lambert; sheets are lit on both sides, their backs dimmer.

    Args:
        backs: what is seen from behind. The surface says so, not a normal map, which may lean past the outline.
    """
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    normals = np.where(backs[:, None], -normals, normals)
    lights = LIGHTS / np.linalg.norm(LIGHTS, axis=1, keepdims=True) @ view.axes()
    light = AMBIENT + np.clip(normals @ lights.T, 0, None) @ STRENGTHS
    return np.where(backs, 0.6, 1.0) * light


def _linear(srgb: np.ndarray) -> np.ndarray:
    """Light of an 8-bit sRGB colour."""
    return nearly_linear(srgb.astype(np.float32) / 255)


def _encoded(light: np.ndarray) -> Any:
    return (nearly_encoded(np.clip(light, 0, 1)) * 255 + 0.5).astype(np.uint8)
