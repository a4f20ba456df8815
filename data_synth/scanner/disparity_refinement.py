"""Sub-pixel disparities: planes fitted to the intensities of windows that keep to one colour.

Semi-global matching prefers whole disparities and grows silhouettes. Around each pixel p a plane of disparity
d(q) = d0 + a x + b y, (x, y) = q - p, is fitted to the intensities by Gauss-Newton:

    minimise  sum_q w(p, q) [(L(q) - R(q - d(q)) - c)^2 + m (d(q) - d_old(q))^2]

c is the difference of the two cameras' brightness. The second term keeps the plane near the disparities found so far
where there is no pattern. The weight w falls with the difference of the colours of p and q, seen under white light, and
is 0 beyond a step of disparity: a window at the painted hem of a shirt does not take in the body behind it, and a
slanted window does not bend.

References: Yoon and Kweon, Adaptive support-weight approach for correspondence search (PAMI 2006), for the weights;
Bleyer, Rhemann and Rother, PatchMatch Stereo (BMVC 2011), for slanted windows.
"""

from __future__ import annotations

from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numba import njit

__all__ = ["refine_disparity"]

BLUR = 0.7
"""Of the images, pixels."""
RADIUS = 4
"""Windows reach so many pixels to each side."""
COLOUR_SCALE = 0.12
"""Distance of colours, 1 = full scale, at which a pixel's weight is a half; camera noise is a third of it."""
STEP = 1.0
"""Pixels of disparity beyond which a neighbour is on another surface."""
INERTIA = 0.1
"""m above, relative to the mean square slope of the intensities."""
SLOPE_PRIOR = 0.01
"""Weight of a level plane, relative to that of the window."""
LARGEST_CHANGE = 1.0
"""Pixels of disparity; what is farther off was a wrong match."""


def refine_disparity(
    disparity: Float32[np.ndarray, "h w"],
    matched: Bool[np.ndarray, "h w"],
    left: UInt8[np.ndarray, "h w"],
    right: UInt8[np.ndarray, "h w"],
    colours: Float32[np.ndarray, "h w 3"],
    *,
    steps: int,
) -> Float32[np.ndarray, "h w"]:
    """Disparities to a tenth of a pixel, from matches to about a third of one.

    Args:
        disparity: column in the left image minus column in the right one, pixels.
        matched: where it is known; other pixels are neither used nor changed.
        colours: of the left camera under white light, 1 = full scale.
        steps: of Gauss-Newton.
    """
    seen_left, seen_right = (cv2.GaussianBlur(image.astype(np.float32), (0, 0), BLUR) for image in (left, right))
    slope = cv2.Sobel(seen_right, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    grid = np.indices(disparity.shape)
    rows, columns = grid[0].astype(np.float32), grid[1].astype(np.float32)
    colours = np.ascontiguousarray(colours)
    found = disparity
    for _ in range(steps):
        seen_at = columns - found
        residual = seen_left - cv2.remap(seen_right, seen_at, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        gradient = cv2.remap(slope, seen_at, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        inertia = np.float32(INERTIA * np.mean(gradient[matched] ** 2)) if matched.any() else np.float32(0)
        found = _planes_at_centre(found, matched, residual, gradient, colours, inertia)
        found = np.clip(found, disparity - LARGEST_CHANGE, disparity + LARGEST_CHANGE)
    return found


@no_type_check  # keeps the type-checking import hook off the function that numba compiles
@njit(cache=True, fastmath=True)
def _planes_at_centre(disparity, matched, residual, gradient, colours, inertia):
    """One Gauss-Newton step: at each pixel the height of the plane that fits its window."""
    height, width = disparity.shape
    result = disparity.copy()
    scale = np.float32(1 / COLOUR_SCALE**2)
    for v in range(height):
        for u in range(width):
            if not matched[v, u]:
                continue
            # Normal equations of (d0, a, b), upper triangle, and their right side; sums that eliminate c.
            s = sx = sy = sxx = sxy = syy = np.float32(0)
            t = tx = ty = np.float32(0)
            weights = g = gx = gy = r = np.float32(0)
            for y in range(max(v - RADIUS, 0), min(v + RADIUS + 1, height)):
                for x in range(max(u - RADIUS, 0), min(u + RADIUS + 1, width)):
                    rise = disparity[y, x] - disparity[v, u]
                    if not matched[y, x] or abs(rise) > STEP:
                        continue
                    apart = np.float32(0)
                    for channel in range(3):
                        apart += (colours[y, x, channel] - colours[v, u, channel]) ** 2
                    weight = 1 / (1 + (apart * scale) ** 2)
                    dx, dy = np.float32(x - u), np.float32(y - v)
                    slope = gradient[y, x]
                    stiff = weight * (slope * slope + inertia)
                    pull = stiff * rise - weight * slope * residual[y, x]
                    s += stiff
                    sx += stiff * dx
                    sy += stiff * dy
                    sxx += stiff * dx * dx
                    sxy += stiff * dx * dy
                    syy += stiff * dy * dy
                    t += pull
                    tx += pull * dx
                    ty += pull * dy
                    weights += weight
                    g += weight * slope
                    gx += weight * slope * dx
                    gy += weight * slope * dy
                    r += weight * residual[y, x]
            s -= g * g / weights
            sx -= g * gx / weights
            sy -= g * gy / weights
            prior = SLOPE_PRIOR * RADIUS**2 / 3 * s
            sxx += prior - gx * gx / weights
            sxy -= gx * gy / weights
            syy += prior - gy * gy / weights
            t += g * r / weights
            tx += gx * r / weights
            ty += gy * r / weights
            # Cramer's rule for d0
            minor, minor_x, minor_y = sxx * syy - sxy * sxy, sxy * sy - sx * syy, sx * sxy - sxx * sy
            determinant = s * minor + sx * minor_x + sy * minor_y
            if determinant > 1e-6 * s * sxx * syy:
                result[v, u] += (minor * t + minor_x * tx + minor_y * ty) / determinant
    return result
