"""True depth, angle, colour and surface images of a camera, by ray casting."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float32, Integer, UInt8
from numba import njit

from capture4d.geometry.ray_casting import TriangleScene
from capture4d.types import Mesh, Rig

__all__ = ["NOTHING", "CameraImages", "Print", "Surface", "SurfaceScene", "nearest_surface"]

NOTHING = 255
"""In a surface image: no surface."""
SHADOW_BIAS = 0.001
"""A surface this share of the way to a lamp before a point does not shade it."""
TILE = 8
"""Rays are cast in square tiles of pixels; one probe ray per tile decides whether it is worth it."""


@dataclass(frozen=True, slots=True, eq=False)
class Print:
    """What is printed on a cloth: an image over its pattern, finer than the cloth's mesh."""

    image: Float32[np.ndarray, "rows columns 3"]
    """sRGB, 0 to 1."""
    places: Float32[np.ndarray, "faces 3 2"]
    """Column and row in the image of each face corner; pixel centres lie at integers."""
    share: Float32[np.ndarray, "faces 3"]
    """1 where a face corner is printed, 0 where it has the surface's own colour."""


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """One thing the scanner sees."""

    mesh: Mesh
    colours: UInt8[np.ndarray, "verts 3"]
    """sRGB per vertex."""
    label: int
    """0 body, 1 garment."""
    voxel_m: float
    """Edge of the voxels it is fused in."""
    painted: Bool[np.ndarray, " verts"] | None = None
    """The vertices of a garment in the paint along its borders, whatever the colours; None if there is none."""
    print: Print | None = None
    """Multiplies the colours, as ink does those of the cloth below it."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraImages:
    """What one camera would see with perfect sensors, on a window of its image."""

    depth: Float32[np.ndarray, "h w"]
    """Metres along the camera's z axis, 0 where there is nothing."""
    cosine: Float32[np.ndarray, "h w"]
    """Of the angle between the ray and the surface; negative where the back of the surface is seen."""
    surface: UInt8[np.ndarray, "h w"]
    """Index of the surface, NOTHING where there is none."""
    colours: Float32[np.ndarray, "h w 3"]
    """0 to 1, lit."""
    origin: tuple[int, int]
    """Row and column of the window's first pixel in the whole image."""

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the whole image."""
        top, left = self.origin
        return slice(top, top + self.depth.shape[0]), slice(left, left + self.depth.shape[1])


class SurfaceScene:
    """Surfaces, lit and ready to be seen from many cameras."""

    def __init__(
        self,
        surfaces: Sequence[Surface],
        *,
        lit: Callable[[Surface], Float32[np.ndarray, "verts 3"]] | None = None,
        thickness_m: float = 0.0,
    ) -> None:
        """Light the surfaces.

        Args:
            lit: vertex colours, 0 to 1, under the light; None shows the surfaces' own colours.
            thickness_m: how much nearer the back of a surface is than its front.
        """
        self._scene = TriangleScene(*((surface.mesh.vertices, surface.mesh.faces) for surface in surfaces))
        self._thickness = np.float32(thickness_m)
        self._first_face = np.cumsum([0, *(len(s.mesh.faces) for s in surfaces)])
        corner_colours = [(lit or unlit)(s)[s.mesh.faces] for s in surfaces]
        self._corner_colours = np.concatenate(corner_colours)  # (F, 3 corners, 3)
        self._print = _joined_prints(surfaces)

    def view(self, rig: Rig, camera: int) -> CameraImages | None:
        """The images of one camera, or None where it sees nothing."""
        width, height = (int(size) for size in rig.image_sizes[camera])
        tiles = self._occupied_tiles(rig, camera, width, height)
        rows, columns = np.nonzero(tiles)
        if not len(rows):
            return None
        top, left = rows.min() * TILE, columns.min() * TILE
        shape = (rows.max() + 1) * TILE - top, (columns.max() + 1) * TILE - left
        within = np.arange(TILE)
        v = np.broadcast_to((rows[:, None, None] * TILE + within[:, None]), (len(rows), TILE, TILE)).ravel()
        u = np.broadcast_to((columns[:, None, None] * TILE + within), (len(rows), TILE, TILE)).ravel()
        inside = (v < height) & (u < width)
        v, u = v[inside], u[inside]
        shape = min(shape[0], height - top), min(shape[1], width - left)
        rays = _rays(rig, camera, u.astype(np.float32), v.astype(np.float32))
        hits = self._scene.cast(rays)
        depth, cosine = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        surface, colours = np.full(shape, NOTHING, np.uint8), np.zeros((*shape, 3), np.float32)
        _fill_images(
            depth,
            cosine,
            surface,
            colours,
            (v - top, u - left),
            rays,
            hits.distance,
            hits.surfaces,
            hits.faces,
            hits.uv,
            hits.normals,
            self._first_face,
            self._corner_colours,
            self._print.image,
            self._print.places,
            self._print.share,
            self._thickness,
        )
        return CameraImages(depth, cosine, surface, colours, origin=(int(top), int(left)))

    def incidence(
        self, points: Float32[np.ndarray, "points 3"], lamp: Float32[np.ndarray, " 3"]
    ) -> Float32[np.ndarray, " points"]:
        """Cosine of the angle at which light from a point reaches points of the surfaces, 0 in the shadow."""
        rays = np.empty((len(points), 6), np.float32)
        rays[:, :3], rays[:, 3:] = lamp, points - lamp
        hits = self._scene.cast(rays)
        reached = hits.distance > 1 - SHADOW_BIAS
        toward = np.einsum("ij,ij->i", rays[:, 3:], hits.normals)
        return np.where(reached, np.abs(toward) / np.linalg.norm(rays[:, 3:], axis=1), np.float32(0))

    def _occupied_tiles(self, rig: Rig, camera: int, width: int, height: int) -> Bool[np.ndarray, "rows columns"]:
        """Tiles whose centre, or a neighbour's, hits something."""
        columns, rows = -(-width // TILE), -(-height // TILE)
        v, u = (index.ravel() * TILE + TILE // 2 for index in np.indices((rows, columns)))
        probes = self._scene.is_met(_rays(rig, camera, u, v))
        tiles = np.pad(probes.reshape(rows, columns), 1)
        tiles = tiles[:-2] | tiles[1:-1] | tiles[2:]
        return tiles[:, :-2] | tiles[:, 1:-1] | tiles[:, 2:]


def nearest_surface(meshes: Sequence[Mesh], points: Float32[np.ndarray, "points 3"]) -> Integer[np.ndarray, " points"]:
    """Which of the meshes is nearest to each point."""
    return TriangleScene(*((mesh.vertices, mesh.faces) for mesh in meshes)).nearest(points).surfaces


def unlit(surface: Surface) -> Float32[np.ndarray, "verts 3"]:
    """The surface's own colours, 0 to 1."""
    return surface.colours.astype(np.float32) / 255


def _joined_prints(surfaces: Sequence[Surface]) -> Print:
    """The print of the one surface that has one, over the faces of all."""
    printed = [surface.print for surface in surfaces if surface.print is not None]
    assert len(printed) <= 1, "one garment is scanned"
    if not printed:
        return Print(np.zeros((0, 0, 3), np.float32), np.zeros((0, 3, 2), np.float32), np.zeros((0, 3), np.float32))
    places = [np.zeros((len(s.mesh.faces), 3, 2), np.float32) if s.print is None else s.print.places for s in surfaces]
    share = [np.zeros((len(s.mesh.faces), 3), np.float32) if s.print is None else s.print.share for s in surfaces]
    return Print(printed[0].image, np.concatenate(places), np.concatenate(share))


def _rays(rig: Rig, camera: int, u: np.ndarray, v: np.ndarray) -> Float32[np.ndarray, "rays 6"]:
    """Rays through pixels (u, v); a direction reaches depth 1, so that the hit distance is the depth."""
    K, T = rig.intrinsics[camera], rig.T_camera_world[camera]
    to_world = np.linalg.inv(K @ T[:3, :3]).astype(np.float32)
    rays = np.empty((len(u), 6), np.float32)
    rays[:, :3] = -T[:3, :3].T @ T[:3, 3]
    for axis in range(3):
        rays[:, 3 + axis] = u * to_world[axis, 0] + v * to_world[axis, 1] + to_world[axis, 2]
    return rays


@no_type_check  # keeps the type-checking import hook off the function that numba compiles
@njit(cache=True)
def _fill_images(
    depth,
    cosine,
    surface,
    colours,
    pixels,
    rays,
    t_hit,
    surface_ids,
    face_ids,
    uv,
    normals,
    first_face,
    corner_colours,
    image,
    places,
    share,
    thickness,
):
    """Scatter the hits of rays to the pixels (rows, columns) they went through."""
    for ray in range(len(rays)):
        if not np.isfinite(t_hit[ray]):
            continue
        row, column = pixels[0][ray], pixels[1][ray]
        direction, normal = rays[ray, 3:], normals[ray]
        length = np.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
        toward = direction[0] * normal[0] + direction[1] * normal[1] + direction[2] * normal[2]
        depth[row, column] = t_hit[ray] - (thickness / max(toward, 0.1 * length) if toward > 0 else 0)
        cosine[row, column] = -toward / length
        surface[row, column] = surface_ids[ray]
        face = first_face[surface_ids[ray]] + face_ids[ray]
        corners = corner_colours[face]
        second, third = uv[ray, 0], uv[ray, 1]
        first = 1 - second - third
        for channel in range(3):
            colours[row, column, channel] = (
                first * corners[0, channel] + second * corners[1, channel] + third * corners[2, channel]
            )
        if len(image) == 0 or max(share[face, 0], share[face, 1], share[face, 2]) == 0:
            continue
        x = first * places[face, 0, 0] + second * places[face, 1, 0] + third * places[face, 2, 0]
        y = first * places[face, 0, 1] + second * places[face, 1, 1] + third * places[face, 2, 1]
        x, y = min(max(x, 0.0), image.shape[1] - 1.001), min(max(y, 0.0), image.shape[0] - 1.001)
        left, top = int(x), int(y)
        across, down = x - left, y - top
        for channel in range(3):
            ink = (1 - down) * ((1 - across) * image[top, left, channel] + across * image[top, left + 1, channel])
            ink += down * ((1 - across) * image[top + 1, left, channel] + across * image[top + 1, left + 1, channel])
            colours[row, column, channel] = (
                first * corners[0, channel] * (1 + share[face, 0] * (ink - 1))
                + second * corners[1, channel] * (1 + share[face, 1] * (ink - 1))
                + third * corners[2, channel] * (1 + share[face, 2] * (ink - 1))
            )
