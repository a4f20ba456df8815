"""What a network draws: both images whole, or a part of one; drawing and sampling as matrices, for many frames at once.

Drawing is linear in the values at the cloth pixels, and so is sampling back. `drawn_values` finds, once for each frame,
the values whose images give the offsets back; images are then drawn when they are learned from, and none is kept.

Letters: P cloth pixels of the layout, Q and V pixels and vertices of a canvas, B frames of a batch, k images.

References: Jin et al., A pixel-based framework for data-driven clothing, SCA 2020, sections 3, 4 and 5.1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from scipy.sparse import csr_matrix, vstack
from torch import Tensor, nn
from torch.nn import functional

from capture4d.geometry.mesh import unique_edges
from wrinkles.offset_images.layout import OffsetLayout

__all__ = ["Canvas", "OffsetSampler", "Window", "drawing_matrix", "drawn_values", "sampling_matrix"]


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """A rectangle of one of the two images, and the cloth that it is there for."""

    image: int
    """0 front, 1 back."""
    top: int
    left: int
    rows: int
    columns: int
    context: tuple[int, int, int, int]
    """Rows from and to, columns from and to, that the loss covers: the cloth and what lies around it."""
    faces: Bool[np.ndarray, " F"]
    """Of the layout: whose pixels are read back."""


def drawing_matrix(layout: OffsetLayout) -> csr_matrix:
    """Texels of front and back, row by row, from values at the pixels: (2 size^2, P)."""
    parts = []
    for raster in layout.rasters:
        rows = np.repeat(raster.texels, 3)
        entries = (raster.barycentric.astype(np.float64).ravel(), (rows, raster.corners.ravel()))
        parts.append(csr_matrix(entries, shape=(layout.size**2, len(layout.vertex))))
    return csr_matrix(vstack(parts))


def sampling_matrix(layout: OffsetLayout) -> csr_matrix:
    """Values at the pixels from the texels, interpolated bilinearly: (P, 2 size^2)."""
    size, count = layout.size, len(layout.vertex)
    uv = layout.uv.astype(np.float64)
    x, y = (np.clip(place, 0, size - 1) for place in (uv[:, 0] * size - 0.5, (1 - uv[:, 1]) * size - 0.5))
    column, row = np.minimum(x.astype(int), size - 2), np.minimum(y.astype(int), size - 2)
    right, down = x - column, y - row
    first = layout.image * size**2 + row * size + column
    texels = np.stack([first, first + 1, first + size, first + size + 1], axis=1)
    weights = np.stack([(1 - right) * (1 - down), right * (1 - down), (1 - right) * down, right * down], axis=1)
    rows = np.repeat(np.arange(count), 4)
    return csr_matrix((weights.ravel(), (rows, texels.ravel())), shape=(count, 2 * size**2))


def drawn_values(
    layout: OffsetLayout, offsets: Float[np.ndarray, "frames P 3"], *, corrections: int = 3
) -> Float32[np.ndarray, "frames P 3"]:
    """Values that `OffsetLayout.draw` draws, after as many corrections, of many frames at once."""
    lost = sampling_matrix(layout) @ drawing_matrix(layout)
    found = np.empty(offsets.shape, np.float32)
    for start in range(0, len(offsets), 64):
        part = np.asarray(offsets[start : start + 64], np.float64)
        wanted = part.transpose(1, 0, 2).reshape(part.shape[1], -1)
        values = wanted
        for _ in range(corrections):
            values = values + (wanted - lost @ values)
        found[start : start + 64] = values.reshape(part.shape[1], -1, 3).transpose(1, 0, 2)
    return found


@dataclass(frozen=True, slots=True, eq=False)
class Canvas:
    """Both images whole, or a window of one."""

    layout: OffsetLayout
    window: Window | None
    texels: csr_matrix
    """(k rows columns, P): draws values."""
    mask: Bool[Tensor, "k rows columns"]
    """Texels that the loss counts: those that show cloth or its padding."""

    @staticmethod
    def create(layout: OffsetLayout, window: Window | None = None) -> Canvas:
        size, matrix = layout.size, csr_matrix(drawing_matrix(layout), dtype=np.float32)
        mask = layout.mask.transpose(2, 0, 1)
        if window is not None:
            rows = window.top + np.arange(window.rows)[:, None]
            columns = window.left + np.arange(window.columns)
            matrix = csr_matrix(matrix[(window.image * size**2 + rows * size + columns).ravel()])
            first, last, left, right = window.context
            wanted = (rows >= first) & (rows < last) & (columns >= left) & (columns < right)
            mask = (mask[window.image][rows, columns] & wanted)[None]
        return Canvas(layout, window, csr_matrix(matrix), torch.from_numpy(np.ascontiguousarray(mask)))

    @property
    def channels(self) -> int:
        return 3 * len(self.mask)

    def draw(self, values: Float[Tensor, "B P 3"]) -> Float[Tensor, "B channels rows columns"]:
        """Images of values at the pixels, as `drawn_values` found them."""
        count, (images, rows, columns) = len(values), self.mask.shape
        flat = values.numpy().transpose(1, 0, 2).reshape(values.shape[1], -1)
        drawn = torch.from_numpy(self.texels @ flat).view(images, rows, columns, count, 3)
        drawn = drawn.permute(3, 0, 4, 1, 2).reshape(count, 3 * images, rows, columns)
        return drawn.contiguous(memory_format=torch.channels_last)


class OffsetSampler(nn.Module):
    """Images back to cloth pixels and vertices, differentiable: of the whole layout, or of a window's cloth."""

    grid: Tensor
    front: Tensor
    pixels: Tensor
    vertices: Tensor
    slot: Tensor
    uses: Tensor
    faces: Tensor
    edges: Tensor

    def __init__(self, layout: OffsetLayout, window: Window | None = None) -> None:
        super().__init__()
        used = np.ones(len(layout.faces), bool) if window is None else window.faces
        pixels = np.arange(len(layout.vertex)) if window is None else np.unique(layout.faces[used])
        count = len(layout.garment.template.vertices)
        vertices = np.arange(count) if window is None else np.unique(layout.vertex[pixels])
        slot = np.searchsorted(vertices, layout.vertex[pixels])
        faces = np.searchsorted(vertices, layout.garment.template.faces[used])
        x, y = layout.uv[pixels, 0], 1 - layout.uv[pixels, 1]
        if window is not None:
            x = (x * layout.size - window.left) / window.columns
            y = (y * layout.size - window.top) / window.rows
        grid = torch.from_numpy(np.stack([2 * x - 1, 2 * y - 1], axis=1).astype(np.float32))
        self.register_buffer("grid", grid)
        self.register_buffer("front", torch.from_numpy(layout.image[pixels] == 0))
        self.register_buffer("pixels", torch.from_numpy(pixels).long())
        self.register_buffer("vertices", torch.from_numpy(vertices).long())
        self.register_buffer("slot", torch.from_numpy(slot).long())
        self.register_buffer("uses", torch.bincount(self.slot, minlength=len(vertices)).clamp(min=1).float())
        self.register_buffer("faces", torch.from_numpy(faces).long())
        self.register_buffer("edges", torch.from_numpy(unique_edges(faces)).long())

    def forward(self, images: Float[Tensor, "B channels rows columns"]) -> Float[Tensor, "B Q 3"]:
        """Values at the pixels, interpolated bilinearly."""
        grid = self.grid[None, :, None].expand(len(images), -1, -1, -1)
        found = [
            functional.grid_sample(part, grid, align_corners=False, padding_mode="border")[..., 0]
            for part in images.split(3, dim=1)
        ]
        values = found[0] if len(found) == 1 else torch.where(self.front, found[0], found[1])
        return values.transpose(1, 2)

    def positions(
        self, values: Float[Tensor, "B Q 3"], points: Float[Tensor, "B Q 3"], axes: Float[Tensor, "B Q 3 3"]
    ) -> Float[Tensor, "B V 3"]:
        """Vertices from offsets of the pixels, in the unit of the offsets and points."""
        cloth = points + torch.einsum("bpca,bpa->bpc", axes, values)
        total = cloth.new_zeros(len(cloth), len(self.uses), 3).index_add_(1, self.slot, cloth)
        return total / self.uses[:, None]
