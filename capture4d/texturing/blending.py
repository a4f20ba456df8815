"""Colours of many frames become one picture: what most frames say, holes filled from around them, no bare texels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8
from scipy.spatial import KDTree

from capture4d.colours.spaces import linear_colours

__all__ = ["blend", "fill_holes", "spread_out"]

AT_ONCE = 1 << 16
"""Texels that are put together at a time."""
TRUSTED_LEVELS = 6.0
"""A frame counts half as much where it differs by so many levels from what most frames say."""
NEIGHBOURS = 8


def blend(
    frames: Sequence[UInt8[np.ndarray, "texels 4"]],
) -> tuple[Float32[np.ndarray, "texels 3"], Bool[np.ndarray, " texels"], Float32[np.ndarray, " texels"]]:
    """One colour for every texel: around the weighted median of the frames, their mean in linear light, in which
    those that differ from the median count less: where cloth has slid, or something passed between.

    Args:
        frames: sRGB levels and a weight, of the same texels.
    Returns:
        sRGB levels; whether any frame has seen the texel; and by how many levels frames differ there in the mean.
    """
    count = len(frames[0])
    colours, seen = np.zeros((count, 3), np.float32), np.zeros(count, bool)
    spread = np.zeros(count, np.float32)
    to_light = linear_colours(np.repeat(np.arange(256)[:, None], 3, axis=1))[:, 0].astype(np.float32)
    for start in range(0, count, AT_ONCE):
        stack = np.stack([frame[start : start + AT_ONCE] for frame in frames])
        levels, weights = stack[..., :3].astype(np.float32), stack[..., 3].astype(np.float32)
        total = weights.sum(axis=0)
        middle = _weighted_median(levels, weights)
        away = np.abs(levels - middle).max(axis=-1)
        good = weights / (1 + (away / TRUSTED_LEVELS) ** 2)
        light = np.einsum("tn,tnc->nc", good, to_light[stack[..., :3]]) / np.maximum(good.sum(axis=0), 1e-6)[:, None]
        block = slice(start, start + levels.shape[1])
        colours[block], seen[block] = _encoded(light), total > 0
        spread[block] = (weights * away).sum(axis=0) / np.maximum(total, 1e-6)
    return colours, seen, spread


def _encoded(light: np.ndarray) -> np.ndarray:
    """sRGB levels, not rounded."""
    return 255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)


def _weighted_median(
    values: Float32[np.ndarray, "frames texels 3"], weights: Float32[np.ndarray, "frames texels"]
) -> Float32[np.ndarray, "texels 3"]:
    """Of each channel by itself."""
    order = np.argsort(values, axis=0, kind="stable")
    sums = np.cumsum(np.take_along_axis(np.broadcast_to(weights[..., None], values.shape), order, axis=0), axis=0)
    at = np.argmax(sums >= sums[-1:] / 2, axis=0)[None]
    return np.take_along_axis(values, np.take_along_axis(order, at, axis=0), axis=0)[0]


def fill_holes(
    colours: Float32[np.ndarray, "texels 3"],
    seen: Bool[np.ndarray, " texels"],
    places: Float64[np.ndarray, "texels 3"],
) -> None:
    """Give texels that nobody has seen the colours that lie nearest on the cloth, across seams as well; in place.

    Args:
        places: of the texels on the template, metres.
    """
    if seen.all() or not seen.any():
        return
    tree = KDTree(places[seen])
    holes = places[~seen]
    found: Any = tree.query(holes, k=min(NEIGHBOURS, int(seen.sum())))
    distance, near = (each.reshape(len(holes), -1) for each in found)
    share = 1 / np.maximum(distance, 1e-6)
    share /= share.sum(axis=1, keepdims=True)
    colours[~seen] = np.einsum("nk,nkc->nc", share, colours[seen][near])


def spread_out(
    picture: UInt8[np.ndarray, "rows columns 3"], known: Bool[np.ndarray, "rows columns"]
) -> UInt8[np.ndarray, "rows columns 3"]:
    """The picture with the nearest known colour wherever there is none: smaller versions of it, as mipmaps are, see no
    background."""
    if known.all():
        return picture
    label: Any = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )[1]
    colour_of = np.zeros((int(label.max()) + 1, 3), np.uint8)
    colour_of[label[known]] = picture[known]
    return colour_of[label]
