"""Offset images: cloth as displacements from the body, drawn in pattern space.

A cloth pixel is a vertex of the template on one UV island, so a vertex on a seam is two pixels. It is bound to a point
p of the body, and carries the offset of the cloth from there, along tangent, bitangent and normal. The tangent is the
direction of the cloth's u, taken on the cloth as it lies shrunk onto the body and turned into the body's tangent
plane (`local`); Jin et al. do not say whether they mean that or the body's own UVs (`body_local`). Islands that face
forwards lie in one image, the others in a second: six channels.

Letters: P cloth pixels, V vertices of the template, B frames of a batch.

References: Jin et al., A pixel-based framework for data-driven clothing, SCA 2020, sections 3 and 4.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, assert_never

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32

from capture4d.body.skinning import PosedBody
from capture4d.errors import InputError
from capture4d.geometry.mesh import doubled_area_vectors, vertex_normals
from capture4d.geometry.tangents import TangentLayout, interpolated_frames, uv_corners
from capture4d.geometry.uv_layout import pack_islands, require_uvs
from capture4d.geometry.uv_raster import UvRaster, rasterise_uv, sample_bilinear
from capture4d.types import Body, Garment, Mesh

__all__ = ["Anchors", "OffsetLayout", "OffsetSpace", "decode", "encode", "worn_part"]

OffsetSpace = Literal["local", "body_local", "root_offset", "root_position"]
AMBIGUOUS = 0.35
"""Islands whose mean normal points less forwards or backwards than this, such as sleeves, go where there is room."""


@dataclass(frozen=True, slots=True, eq=False)
class Anchors:
    """Where the offsets of a frame start, and along which axes they run."""

    points: Float64[np.ndarray, "P 3"]
    axes: Float64[np.ndarray, "P 3 3"]
    """Orthonormal columns: tangent, bitangent, normal."""


def encode(anchors: Anchors, cloth: Float[np.ndarray, "P 3"]) -> Float64[np.ndarray, "P 3"]:
    """Offsets of cloth pixels, metres: R^T (x - p)."""
    return np.einsum("pca,pc->pa", anchors.axes, cloth - anchors.points)


def decode(anchors: Anchors, offsets: Float[np.ndarray, "P 3"]) -> Float64[np.ndarray, "P 3"]:
    """Positions of cloth pixels: p + R dx."""
    return anchors.points + np.einsum("pca,pa->pc", anchors.axes, offsets)


@dataclass(frozen=True, slots=True, eq=False)
class OffsetLayout:
    """The cloth pixels of a garment and the two images they lie in."""

    garment: Garment
    size: int
    vertex: Int32[np.ndarray, " P"]
    """Vertex of the template each pixel belongs to."""
    uv: Float32[np.ndarray, "P 2"]
    image: Int32[np.ndarray, " P"]
    """0 front, 1 back."""
    faces: Int32[np.ndarray, "F 3"]
    """Faces between pixels."""
    tangents: TangentLayout
    rasters: tuple[UvRaster, UvRaster]

    @staticmethod
    def create(garment: Garment, size: int, *, padding: int = 4) -> OffsetLayout:
        """Share the islands out, lay them out at one scale, rasterise.

        Raises:
            InputError: the template has no UVs or islands that do not fit, or is not bound to a body.
        """
        mesh = garment.template
        mesh_uv = require_uvs(mesh)
        if garment.embedding_faces is None:
            raise InputError("template: expected a garment bound to a body, found none; run: capture4d template MESH")
        islands = TangentLayout(mesh.faces, mesh_uv).islands()
        side = _sides(mesh, islands)[islands]
        gap = (2 * padding + 2) / size
        kept = [side == 0, side == 1]
        numbers = [np.unique(islands[keep], return_inverse=True)[1].astype(np.int32) for keep in kept]
        uv = np.empty_like(mesh_uv)
        drawn = [index for index in range(2) if kept[index].any()]
        for index, packed in zip(drawn, pack_islands([mesh_uv[kept[i]] for i in drawn], [numbers[i] for i in drawn],
                                                     gap=gap), strict=True):  # fmt: skip
            uv[kept[index]] = packed
        keyed = uv + 2 * side[:, None, None].astype(np.float32)  # equal UVs of two images are two pixels
        faces = uv_corners(mesh.faces, keyed)
        count = int(faces.max()) + 1
        vertex, place, image = np.empty(count, np.int32), np.empty((count, 2), np.float32), np.empty(count, np.int32)
        vertex[faces], place[faces], image[faces] = mesh.faces, uv, side[:, None]
        flat = np.zeros((count, 3), np.float32)
        front, back = (rasterise_uv(Mesh(flat, faces[keep], uv[keep]), size, padding=padding) for keep in kept)
        return OffsetLayout(garment, size, vertex, place, image, faces, TangentLayout(faces, uv), (front, back))

    @property
    def mask(self) -> Bool[np.ndarray, "size size 2"]:
        """Texels that show cloth or its padding: W of the grid loss."""
        return np.stack([raster.image(np.ones(len(raster.texels), bool)) for raster in self.rasters], axis=-1)

    def anchors(self, body: PosedBody, space: OffsetSpace = "local") -> Anchors:
        """Where offsets start in a pose.

        Raises:
            InputError: `body_local` is wanted of a body without UVs.
        """
        garment, faces = self.garment, body.shaped.body.template.faces
        assert garment.embedding_faces is not None
        assert garment.embedding_barycentric is not None
        skinned = body.vertices()
        corners, weights = faces[garment.embedding_faces], garment.embedding_barycentric.astype(np.float64)
        points = np.einsum("vk,vkc->vc", weights, skinned[corners])[self.vertex]
        root = body.transforms[0]
        match space:
            case "local" | "body_local":
                at_vertices = vertex_normals(skinned, faces)
                normals = np.einsum("vk,vkc->vc", weights, at_vertices[corners])[self.vertex]
                normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
                if space == "body_local":
                    bound = garment.embedding_faces[self.vertex]
                    layout = TangentLayout(faces, require_uvs(body.shaped.body.template))
                    at_corners = layout.tangents(skinned, at_vertices)[bound]
                    tangents = np.einsum("pk,pkc->pc", weights[self.vertex], at_corners)
                    return Anchors(
                        points, interpolated_frames(normals, tangents, layout.sign[bound]).transpose(0, 2, 1)
                    )
                # cloth shrunk to a point has no direction of its own; the edge of its body face turns with the body
                edge = (skinned[corners[:, 1]] - skinned[corners[:, 0]])[self.vertex]
                across = edge - np.einsum("pc,pc->p", edge, normals)[:, None] * normals
                tangents = np.empty_like(points)
                tangents[self.faces] = self.tangents.tangents(points, normals, fallback=across)
                frames = interpolated_frames(normals, tangents, np.ones(len(points)))
                return Anchors(points, frames.transpose(0, 2, 1))
            case "root_offset":
                return Anchors(points, np.broadcast_to(root[:3, :3], (len(points), 3, 3)))
            case "root_position":
                centre = root[:3, :3] @ body.shaped.joints[0] + root[:3, 3]
                axes = np.broadcast_to(root[:3, :3], (len(points), 3, 3))
                return Anchors(np.broadcast_to(centre, points.shape), axes)
            case _:
                assert_never(space)

    def draw(self, offsets: Float[np.ndarray, "P 3"], *, corrections: int = 3) -> Float32[np.ndarray, "size size 6"]:
        """The two images of pixel values, side by side in their channels.

        Args:
            corrections: how often what sampling back loses, mostly at corners and borders of the cloth, is added to the
                values that are drawn (van Cittert's iteration). 0 draws them as the paper does.
        """
        values, images = np.asarray(offsets, np.float64), self._drawn(offsets)
        for _ in range(corrections):
            values = values + (offsets - self.sample(images))
            images = self._drawn(values)
        return images

    def sample(self, images: Float[np.ndarray, "size size 6"]) -> Float32[np.ndarray, "P 3"]:
        """Images at the pixels, interpolated bilinearly; `wrinkles.offset_images.canvas`
        does it for batches."""
        front, back = (sample_bilinear(part, self.uv) for part in (images[..., :3], images[..., 3:]))
        return np.where((self.image == 0)[:, None], front, back)

    def _drawn(self, values: np.ndarray) -> np.ndarray:
        images = [raster.image(raster.at_vertices(values).astype(np.float32)) for raster in self.rasters]
        return np.concatenate(images, axis=-1)

    def vertices(self, cloth: Float[np.ndarray, "P 3"]) -> Float64[np.ndarray, "V 3"]:
        """Template vertices from pixel positions: the mean of the pixels of a vertex."""
        count = len(self.garment.template.vertices)
        uses = np.maximum(np.bincount(self.vertex, minlength=count), 1)
        sums = [np.bincount(self.vertex, cloth[:, axis], minlength=count) for axis in range(3)]
        return np.stack(sums, axis=1) / uses[:, None]


def worn_part(layout: OffsetLayout, body: Body) -> tuple[OffsetLayout, Body]:
    """The layout on the skin that its garment is bound to, and on the faces around that: the same
    anchors, up to rounding, in less time, where many frames are to be encoded or decoded."""
    garment, faces = layout.garment, body.template.faces
    assert garment.embedding_faces is not None
    under = np.zeros(len(body.template.vertices), bool)
    under[faces[garment.embedding_faces]] = True
    near = under[faces].any(axis=1)
    kept, renumbered = np.unique(faces[near], return_inverse=True)
    uv, bent, regions = body.template.uv, body.pose_directions, body.regions
    part = Mesh(
        body.template.vertices[kept], renumbered.reshape(-1, 3).astype(np.int32), None if uv is None else uv[near]
    )
    place = (np.cumsum(near) - 1).astype(np.int32)
    worn = replace(garment, embedding_faces=place[garment.embedding_faces])
    return replace(layout, garment=worn), replace(
        body, template=part, shape_directions=body.shape_directions[:, kept], skin_weights=body.skin_weights[kept],
        pose_directions=None if bent is None else bent[:, kept], regions=None if regions is None else regions[kept],
    )  # fmt: skip


def _sides(mesh: Mesh, islands: np.ndarray) -> np.ndarray:
    """The image of each island: 0 for those that face forwards (+Z) at rest, 1 for the others."""
    vectors = doubled_area_vectors(mesh.vertices.astype(float), mesh.faces) / 2
    areas = np.bincount(islands, np.linalg.norm(vectors, axis=1))
    forwards = np.bincount(islands, vectors[:, 2]) / np.maximum(areas, 1e-12)
    side = np.where(forwards > 0, 0, 1).astype(np.int32)
    filled = [float(areas[(np.abs(forwards) >= AMBIGUOUS) & (side == index)].sum()) for index in range(2)]
    for island in np.argsort(-areas, kind="stable"):
        if abs(forwards[island]) < AMBIGUOUS:
            side[island] = int(filled[1] < filled[0])
            filled[side[island]] += float(areas[island])
    return side
