"""From changed pictures to a changed garment: only differences count.

What was drawn lost something to the grid of texels, and padding is there for filters alone. So the stored offsets stay,
and the difference of the changed pictures from those that were written is added: where nobody touched a picture nothing
changes, in any format, and a program that clears what lies outside the islands ruins nothing, because padding takes the
change of the nearest texel of the cloth.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32, Float64
from scipy.ndimage import distance_transform_edt

from capture4d.body.skinning import PosedBody
from wrinkles.offset_images.layout import OffsetLayout, OffsetSpace, decode

__all__ = ["changed_vertices", "padded_change"]


def padded_change(
    layout: OffsetLayout, change: Float32[np.ndarray, "size size 6"]
) -> Float32[np.ndarray, "size size 6"]:
    """A change with that of the nearest texel whose centre lies on cloth wherever none does."""
    padded = np.zeros_like(change)
    for side, raster in enumerate(layout.rasters):
        if not len(raster.texels):
            continue
        inside = raster.image(raster.inside)
        nearest = distance_transform_edt(~inside, return_distances=False, return_indices=True)
        assert nearest is not None
        row, column = nearest
        part = slice(3 * side, 3 * side + 3)
        padded[..., part] = change[row, column, part]
    return padded


def changed_vertices(
    layout: OffsetLayout,
    body: PosedBody,
    vertices: Float[np.ndarray, "V 3"],
    offsets_cm: Float[np.ndarray, "P 3"],
    change_cm: Float32[np.ndarray, "size size 6"],
    *,
    space: OffsetSpace = "local",
) -> Float64[np.ndarray, "V 3"]:
    """The garment of a frame after its pictures were changed, metres; a vertex whose texels did not change stays.

    Args:
        vertices: of the frame, metres.
        offsets_cm: that were drawn.
        change_cm: of the pictures, as `read_change` has it.
    """
    anchors = layout.anchors(body, space)
    moved = layout.sample(padded_change(layout, change_cm)).astype(np.float64)
    before = decode(anchors, 0.01 * np.asarray(offsets_cm, np.float64))
    after = decode(anchors, 0.01 * (offsets_cm + moved))
    return vertices + layout.vertices(after - before)
