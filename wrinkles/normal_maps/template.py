"""Pairs of normal maps: the low one from a registered garment, the high one from the scan it was registered to."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float, Float32, Float64

from capture4d.geometry.islands.map_seams import Gutter, SeamTable, find_gutter, seam_table
from capture4d.geometry.mesh import normalised, vertex_normals
from capture4d.geometry.tangents import TangentLayout, frames_at
from capture4d.geometry.uv_layout import unit_square
from capture4d.geometry.uv_raster import UvRaster, rasterise_uv
from capture4d.types import Garment, Mesh
from wrinkles.normal_maps.config import MapConfig, ProjectionConfig
from wrinkles.normal_maps.scan_normals import TexelNormals, combine_frames, project_scan
from wrinkles.normal_maps.spaces import garment_rotation, to_tangent

__all__ = ["FramePair", "MapTemplate", "frame_pairs", "temporal_window"]

TEXELS_AT_ONCE = 1 << 18
"""Frames of so many take 60 MB; a map of 4096 has forty times as many."""


@dataclass(frozen=True, slots=True, eq=False)
class MapTemplate:
    """A garment and its map, analysed once."""

    mesh: Mesh
    """The template, its UVs in the unit square."""
    raster: UvRaster
    """Beyond seams it shows the cloth across them."""
    gutter: Gutter
    seams: SeamTable
    tangents: TangentLayout
    reference: Float32[np.ndarray, "V 3"]
    """The vertices to which garment coordinates refer."""

    @staticmethod
    def create(garment: Garment, config: MapConfig) -> MapTemplate:
        """Lay out, rasterise and analyse. Garment coordinates refer to this garment's own template.

        Raises:
            InputError: the template has no UVs, or such as do not fit an image, or overlapping islands.
        """
        gap = (2 * config.padding + 2) / config.size
        return MapTemplate.laid_out(unit_square(garment.template, layout=config.layout, gap=gap), config)

    @staticmethod
    def laid_out(mesh: Mesh, config: MapConfig) -> MapTemplate:
        """The same of a template whose UVs are those of the maps already."""
        assert mesh.uv is not None
        bare = rasterise_uv(mesh, config.size, padding=config.padding)
        gutter = find_gutter(mesh, bare)
        return MapTemplate(
            mesh, gutter.shown_by(bare), gutter, seam_table(mesh, bare), TangentLayout(mesh.faces, mesh.uv),
            mesh.vertices,
        )  # fmt: skip

    def at(self, config: MapConfig) -> MapTemplate:
        """The same at another number of texels."""
        return MapTemplate.laid_out(self.mesh, config).referred_to(self.reference)

    def referred_to(self, reference: Float32[np.ndarray, "V 3"]) -> MapTemplate:
        """The same with garment coordinates of another copy of the template: one network's, or another take's."""
        return replace(self, reference=reference)

    def low_normals(self, vertices: Float[np.ndarray, "V 3"]) -> Float32[np.ndarray, "N 3"]:
        """The template's interpolated vertex normals in a frame: unit, world, per texel."""
        normals = vertex_normals(np.asarray(vertices, np.float64), self.mesh.faces)
        parts = [normalised(self.raster.part(part).at_vertices(normals)).astype(np.float32) for part in self._parts()]
        return np.concatenate(parts)

    def frames(self, vertices: Float[np.ndarray, "V 3"]) -> Float64[np.ndarray, "N 3 3"]:
        """Tangent frames per texel: rows tangent, bitangent, normal. Beyond a seam, those of the cloth across it,
        turned so that they go on where the texel's own island ends."""
        return np.concatenate(list(self._frames(vertices)))

    def across_seams(self, image: Float[np.ndarray, "size size C"]) -> Float32[np.ndarray, "size size C"]:
        """A map in a global space, alike on both sides of every seam, with the cloth across in the gutters."""
        return self.gutter.filled(self.seams.blended(np.ascontiguousarray(image), self.raster), self.raster)

    def tangent_image(
        self, normals: Float[np.ndarray, "N 3"], vertices: Float[np.ndarray, "V 3"]
    ) -> Float32[np.ndarray, "size size 3"]:
        """The map in tangent space of world normals; flat, (0, 0, 1), where it shows nothing."""
        local = np.empty((len(normals), 3), np.float32)
        for part, frames in zip(self._parts(), self._frames(vertices), strict=True):
            local[part] = to_tangent(normals[part], frames)
        image = self.raster.image(local)
        image[~self.raster.image(np.ones(len(normals), bool))] = (0, 0, 1)
        return image

    def _parts(self) -> list[slice]:
        count = len(self.raster.texels)
        return [slice(start, start + TEXELS_AT_ONCE) for start in range(0, count, TEXELS_AT_ONCE)] or [slice(0, 0)]

    def _frames(self, vertices: Float[np.ndarray, "V 3"]) -> Iterator[Float64[np.ndarray, "part 3 3"]]:
        """`frames`, a part of the texels at a time."""
        normals = vertex_normals(np.asarray(vertices, np.float64), self.mesh.faces)
        tangents, gutter = self.tangents.tangents(vertices, normals), self.gutter

        at = partial(frames_at, self.tangents, normals=normals, tangents=tangents)
        # Both frames of a seam point have the same normal: what carries the one to the other turns about it.
        own, other = (at(*side) for side in zip(gutter.seam_faces, gutter.seam_barycentric, strict=True))
        turn = own @ np.swapaxes(other, 1, 2)
        for part in self._parts():
            found = at(self.raster.faces[part], self.raster.barycentric[part])
            first, last = np.searchsorted(gutter.texels, (part.start, part.stop))
            here = gutter.texels[first:last] - part.start
            found[here] = turn[first:last] @ found[here]
            yield found

    def rotation(self, vertices: Float[np.ndarray, "V 3"]) -> Float64[np.ndarray, "3 3"]:
        """World from garment coordinates; `normals @ rotation` are normals in garment coordinates."""
        return garment_rotation(self.reference, vertices)


@dataclass(frozen=True, slots=True, eq=False)
class FramePair:
    """Normals of one frame, world coordinates, per texel of the template's raster."""

    frame_id: int
    low: Float32[np.ndarray, "N 3"]
    high: TexelNormals


def temporal_window(frame_ids: Sequence[int], index: int, *, fps: float, config: ProjectionConfig) -> range:
    """Positions of the frames averaged for one: a run around it without gaps, next to each other in time."""
    reach = config.temporal_frames // 2

    def adjoin(a: int, b: int) -> bool:
        return a >= 0 and b < len(frame_ids) and (frame_ids[b] - frame_ids[a]) / fps <= config.temporal_span_s

    first = last = index
    while index - first < reach and adjoin(first - 1, first):
        first -= 1
    while last - index < reach and adjoin(last, last + 1):
        last += 1
    return range(first, last + 1)


def frame_pairs(
    template: MapTemplate,
    frame_ids: Sequence[int],
    positions: range,
    *,
    vertices: Callable[[int], Float32[np.ndarray, "V 3"]],
    scan: Callable[[int], Mesh | None],
    fps: float,
    config: ProjectionConfig,
) -> Iterator[FramePair]:
    """Pairs of a run of frames; each scan is read once.

    Args:
        positions: of the frames wanted in `frame_ids`.
        vertices, scan: the registered template and the garment's scan of a frame, by its position; a frame without a
            scan is "no information" throughout.
    """
    scaled = replace(config, blur_texels=config.blur_texels * template.raster.size / 256)
    read: deque[tuple[int, np.ndarray, tuple[TexelNormals, np.ndarray]]] = deque()
    for position in positions:
        window = temporal_window(frame_ids, position, fps=fps, config=config)
        while read and read[0][0] < window.start:
            read.popleft()
        start = read[-1][0] + 1 if read else window.start
        for ahead in range(max(start, window.start), window.stop):
            placed = vertices(ahead)
            low = template.low_normals(placed)
            surface = scan(ahead)
            if surface is None:
                single = TexelNormals(np.zeros_like(low), np.zeros(len(low), bool))
            else:
                points = template.raster.at_vertices(placed.astype(np.float64))
                single = project_scan(points, low, surface, config)
            read.append((ahead, low, (single, template.frames(placed))))
        entries = [entry for entry in read if entry[0] in window]
        centre = position - window.start
        high = combine_frames([entry[2] for entry in entries], centre, template.raster, scaled)
        yield FramePair(int(frame_ids[position]), entries[centre][1], high)
