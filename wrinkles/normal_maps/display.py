"""Maps made fit to be shown: holes filled from their surroundings. For pictures and renderers, never for learning."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

__all__ = ["fill_holes"]


def fill_holes(image: Float[np.ndarray, "H W C"], valid: Bool[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W C"]:
    """Valid texels as they are, the others from the nearest coarser level of a pyramid that knows them (push-pull).

    For tangent-space maps: a hole then takes on the wrinkles around it, fading into the template's own surface.
    """
    weight = valid.astype(np.float32)
    values = image.astype(np.float32) * weight[..., None]
    return _filled(values, weight)


def _filled(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """`values` are premultiplied by `weight`."""
    known = np.divide(values, weight[..., None], out=np.zeros_like(values), where=weight[..., None] > 0)
    if min(weight.shape) <= 1 or (weight > 0).all():
        return known
    height, width = weight.shape
    half = ((width + 1) // 2, (height + 1) // 2)
    coarse_values = cv2.resize(values, half, interpolation=cv2.INTER_AREA).reshape(half[1], half[0], -1)
    coarse_weight = cv2.resize(weight, half, interpolation=cv2.INTER_AREA).reshape(half[1], half[0])
    coarse = _filled(coarse_values, coarse_weight)
    finer = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR).reshape(height, width, -1)
    share = np.minimum(weight, 1)[..., None]
    return known * share + finer * (1 - share)
