"""A garment cut into patches, each with a network of its own: windows, stitching, and what is left of the borders.

A patch is a label of faces; one that lies in both images is two. Its window is a square around the middle of what it
covers, which the network draws with some context beyond the patch. Where patches meet, the pixels they share are
averaged, and a filter projects the whole garment onto principal components of the offsets that were learned from.

Letters: P cloth pixels, F faces, E edges.

References: Jin et al., A pixel-based framework for data-driven clothing, SCA 2020, sections 5.1 and 7.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Int, Int32
from torch import Tensor, nn

from capture4d.errors import InputError
from capture4d.geometry.mesh import doubled_area_vectors, normalised
from capture4d.learning.networks import ImageDecoder
from wrinkles.offset_images.canvas import OffsetSampler, Window
from wrinkles.offset_images.layout import OffsetLayout
from wrinkles.offset_images.networks import principal_offsets

__all__ = ["OffsetFilter", "Patchwork", "cut_windows", "even_labels", "kink_deg", "stitched", "strip_window"]


def even_labels(layout: OffsetLayout, count: int) -> Int32[np.ndarray, " F"]:
    """Labels of patches of like size, half of them in each image: the longest piece is cut in two, again and again.

    Args:
        count: patches in all; the paper has 28.
    """
    centres = layout.uv[layout.faces].mean(axis=1)
    sides = layout.image[layout.faces[:, 0]]
    islands = layout.tangents.islands()
    pieces = [np.flatnonzero(islands == island) for island in np.unique(islands)]
    found: list[np.ndarray] = []
    for side in range(2):
        own = [piece for piece in pieces if sides[piece[0]] == side]
        while own and len(own) < -(-count // 2):
            extents = [np.ptp(centres[piece], axis=0) if len(piece) > 1 else np.zeros(2) for piece in own]
            longest = int(np.argmax([extent.max() for extent in extents]))
            piece = own.pop(longest)
            along = centres[piece, int(np.argmax(extents[longest]))]
            low = along <= (along.min() + along.max()) / 2
            if low.all():
                raise InputError(
                    f"patches: expected at most {len(own) + 1} in an image, found {count} asked for in two"
                )
            own += [piece[low], piece[~low]]
        found += own
    labels = np.empty(len(layout.faces), np.int32)
    for label, piece in enumerate(found):
        labels[piece] = label
    return labels


def cut_windows(layout: OffsetLayout, labels: Int[np.ndarray, " F"], side: int, context: int) -> tuple[Window, ...]:
    """The window of each patch, by label and image.

    Args:
        side: texels along the windows.
        context: texels around a patch that the loss covers as well, where the window has room for them.
    Raises:
        InputError: the labels are not those of the faces, the images are smaller than the windows, or a patch does not
            fit into one.
    """
    if labels.shape != (len(layout.faces),):
        raise InputError(f"patches: expected a label for each of {len(layout.faces)} faces, found {labels.shape}")
    if side > layout.size:
        raise InputError(f"patches: expected windows of at most {layout.size} texels, as the images have, found {side}")
    images = layout.image[layout.faces[:, 0]]
    windows = []
    for label in np.unique(labels):
        for image in range(2):
            faces = (labels == label) & (images == image)
            if not faces.any():
                continue
            low, high = _covered(layout, faces)
            if (needed := int((high - low).max())) > side:
                raise InputError(f"patches: expected none longer than the {side} texels of a window, found "
                                 f"{needed} texels in label {label}")  # fmt: skip
            windows.append(_window(layout, image, faces, (side, side), context))
    return tuple(windows)


def strip_window(layout: OffsetLayout, rows: int, columns: int, padding: int) -> Window:
    """The window of a garment that is one strip, such as a necktie, along the longer side of its image.

    Raises:
        InputError: the garment lies in both images, or is wider or longer than the strip.
    """
    if max(rows, columns) > layout.size:
        raise InputError(f"expected images as long as a strip of {rows} x {columns} texels, found {layout.size}")
    if len(images := np.unique(layout.image)) > 1:
        raise InputError("expected a garment that lies in one image, such as a necktie, found one with front and back")
    faces = np.ones(len(layout.faces), bool)
    low, high = _covered(layout, faces)
    size = (rows, columns) if (high - low)[0] <= (high - low)[1] else (columns, rows)
    if ((high - low) > size).any():
        found = " x ".join(map(str, high - low))
        raise InputError(f"expected a garment that fits a strip of {rows} x {columns} texels, found {found}")
    return _window(layout, int(images[0]), faces, size, padding)


def _covered(layout: OffsetLayout, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns from which to which texels are read for faces."""
    uv = layout.uv[np.unique(layout.faces[faces])].astype(np.float64)
    places = np.stack([(1 - uv[:, 1]) * layout.size, uv[:, 0] * layout.size], axis=1)
    return np.floor(places.min(axis=0) - 0.5).astype(int), np.ceil(places.max(axis=0) + 0.5).astype(int)


def _window(layout: OffsetLayout, image: int, faces: np.ndarray, size: tuple[int, int], context: int) -> Window:
    low, high = _covered(layout, faces)
    shape = np.array(size)
    first = np.clip(np.round((low + high - shape) / 2).astype(int), 0, layout.size - shape)
    top, left, rows, columns = (int(each) for each in (*first, *shape))
    begin, end = np.maximum(low - context, first), np.minimum(high + context, first + shape)
    covered = (int(begin[0]), int(end[0]), int(begin[1]), int(end[1]))
    return Window(image, top, left, rows, columns, covered, faces)


def stitched(
    layout: OffsetLayout, parts: Sequence[tuple[OffsetSampler, Float[Tensor, "frames _ 3"]]]
) -> Float[Tensor, "frames P 3"]:
    """Offsets of all pixels from those of each patch; the mean where patches share a pixel."""
    frames = len(parts[0][1])
    total, uses = torch.zeros(frames, len(layout.vertex), 3), torch.zeros(len(layout.vertex))
    for sampler, values in parts:
        total[:, sampler.pixels] += values
        uses[sampler.pixels] += 1
    assert bool((uses > 0).all()), "every face has a label"
    return total / uses[:, None]


@dataclass(frozen=True, slots=True, eq=False)
class OffsetFilter:
    """Principal components of a whole garment's offsets, which know no patches."""

    mean: Float32[np.ndarray, " values"]
    basis: Float32[np.ndarray, "K values"]
    """Orthonormal, 3 P values each."""

    @staticmethod
    def learned(offsets: Float[Tensor, "frames P 3"], components: int) -> OffsetFilter:
        """Of the frames to learn from; at most as many components as they have. The paper keeps 2048 of 16,000."""
        mean, basis, _ = principal_offsets(offsets, components)
        return OffsetFilter(mean.numpy(), basis.numpy())

    def __call__(self, offsets: Float[Tensor, "frames P 3"]) -> Float[Tensor, "frames P 3"]:
        return _projected(offsets, torch.from_numpy(self.mean), torch.from_numpy(self.basis))


class Patchwork(nn.Module):
    """The decoders of all patches and the filter as one network: from a pose to the offsets of all cloth pixels."""

    mean: Tensor
    basis: Tensor

    def __init__(
        self,
        layout: OffsetLayout,
        samplers: Sequence[OffsetSampler],
        decoders: Sequence[ImageDecoder],
        kept: OffsetFilter,
    ) -> None:
        super().__init__()
        self.decoders = nn.ModuleList(decoders)
        self.layout = layout
        self.samplers = list(samplers)  # they follow from the layout, and are no weights
        self.register_buffer("mean", torch.from_numpy(kept.mean))
        self.register_buffer("basis", torch.from_numpy(kept.basis))

    def forward(self, pose: Float[Tensor, "B pose"]) -> Float[Tensor, "B P 3"]:
        made = [sampler(decoder(pose)) for sampler, decoder in zip(self.samplers, self.decoders, strict=True)]
        return _projected(stitched(self.layout, list(zip(self.samplers, made, strict=True))), self.mean, self.basis)


def _projected(
    offsets: Float[Tensor, "B P 3"], mean: Float[Tensor, " values"], basis: Float[Tensor, "K values"]
) -> Float[Tensor, "B P 3"]:
    return (mean + (offsets.flatten(1) - mean) @ basis.T @ basis).view_as(offsets)


def kink_deg(
    vertices: Float[np.ndarray, "frames V 3"], faces: Int[np.ndarray, "F 3"], labels: Int[np.ndarray, " F"]
) -> float:
    """Mean angle between the faces of two patches along the borders of the patches, degrees; NaN without borders.

    Cloth is bent there as anywhere: what stitching adds is this less the same of the true vertices.
    """
    sides = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1).astype(np.int64)
    keys = sides[:, 0] * (faces.max(initial=0) + 1) + sides[:, 1]
    order = np.argsort(keys, kind="stable")
    twice = np.flatnonzero(keys[order][1:] == keys[order][:-1])
    first, second = order[twice] // 3, order[twice + 1] // 3
    border = labels[first] != labels[second]
    if not border.any():
        return float("nan")
    angles = []
    for frame in vertices:
        normals = normalised(doubled_area_vectors(frame.astype(np.float64), faces))
        cosines = np.einsum("ec,ec->e", normals[first[border]], normals[second[border]])
        angles.append(np.degrees(np.arccos(np.clip(cosines, -1, 1))).mean())
    return float(np.mean(angles))
