"""What a depth sensor does to a true depth image: correlated noise, dropouts, colour noise.

Random fields are drawn once per frame as one periodic texture, and every camera reads it from a random offset: that
costs a tenth of drawing them per camera, and neighbouring cameras stay uncorrelated.
"""

from __future__ import annotations

from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from jaxtyping import Bool, Float32

from data_synth.scanner.config import NoiseConfig

__all__ = ["NoiseFields", "corrupt_depth", "draw_noise_fields", "periodic_gaussian_field", "silhouettes"]


@dataclass(frozen=True, slots=True, eq=False)
class NoiseFields:
    """One frame's random textures, zero mean, unit variance, repeated beyond their period so that windows are views."""

    period: int
    depth: Float32[np.ndarray, "size size"]
    blobs: Float32[np.ndarray, "size size"]
    colour: Float32[np.ndarray, "size size 3"]

    def window(self, field: np.ndarray, shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
        """A window of one of the fields at a random offset."""
        top, left = rng.integers(0, self.period, 2)
        return field[top : top + shape[0], left : left + shape[1]]


def draw_noise_fields(
    config: NoiseConfig, rng: np.random.Generator, *, largest_image: int, period: int = 1024
) -> NoiseFields:
    """Draw one frame's textures, for images of up to `largest_image` pixels in width and height."""

    def repeat(field: np.ndarray) -> np.ndarray:
        return np.pad(field, [(0, largest_image)] * 2 + [(0, 0)] * (field.ndim - 2), mode="wrap")

    return NoiseFields(
        period=period,
        depth=repeat(periodic_gaussian_field(period, config.correlation_px, rng)),
        blobs=repeat(periodic_gaussian_field(period, config.blob_px, rng)),
        colour=repeat(rng.standard_normal((period, period, 3), dtype=np.float32)),
    )


def periodic_gaussian_field(size: int, sigma_px: float, rng: np.random.Generator) -> Float32[np.ndarray, "size size"]:
    """White noise blurred by a Gaussian of `sigma_px`, zero mean, unit variance, seamless when tiled."""
    white = rng.standard_normal((size, size), dtype=np.float32)
    if sigma_px > 0:
        gain = np.exp(-2 * (np.pi * sigma_px * np.fft.fftfreq(size)) ** 2)
        white = np.fft.irfft2(np.fft.rfft2(white) * gain[:, None] * gain[: size // 2 + 1], s=(size, size))
    white -= white.mean()
    return (white / white.std()).astype(np.float32)


def silhouettes(depth: Float32[np.ndarray, "h w"], step_m: float) -> Bool[np.ndarray, "h w"]:
    """Pixels next to (3x3) a depth that differs by more than `step_m`; no data (0) differs from everything."""
    high, low = depth.copy(), depth.copy()
    for axis in (0, 1):
        high, low = _window(np.maximum, high, axis), _window(np.minimum, low, axis)
    return high - low > step_m


def corrupt_depth(
    depth: Float32[np.ndarray, "h w"],
    cosine: Float32[np.ndarray, "h w"],
    fields: NoiseFields,
    *,
    config: NoiseConfig,
    rng: np.random.Generator,
) -> Float32[np.ndarray, "h w"]:
    """The depth image that the sensor returns, metres, 0 where it returns nothing.

    Args:
        depth: true depth along the camera's z axis, 0 where there is nothing.
        cosine: of the angle between the ray and the surface normal.
    """
    noise = fields.window(fields.depth, depth.shape, rng)
    blobs = fields.window(fields.blobs, depth.shape, rng)
    edge = silhouettes(depth, config.silhouette_step_m)
    near_edge = edge
    for _ in range(2):
        near_edge = _window(np.logical_or, _window(np.logical_or, near_edge, 0), 1)
    lost = (
        edge
        | (near_edge & (blobs > _level(config.silhouette_loss)))
        | (cosine < config.lost_cosine)
        | (blobs > _level(config.blob_loss))
    )
    lost |= (cosine < config.weak_cosine) & (blobs < -_level(config.weak_loss))
    spread = config.sigma_m * (depth / config.reference_depth_m) ** 2 / np.maximum(cosine, config.grazing_floor)
    return np.where(lost, np.float32(0), depth + (spread * noise).astype(np.float32))


def _level(share: float) -> float:
    """The level that a standard normal value exceeds with probability `share`."""
    return NormalDist().inv_cdf(1 - share) if share > 0 else np.inf


def _window(operation: np.ufunc, image: np.ndarray, axis: int) -> np.ndarray:
    """`operation` over each pixel and its two neighbours along an axis."""
    image = image.swapaxes(0, axis)
    result = image.copy()
    operation(result[1:], image[:-1], out=result[1:])
    operation(result[:-1], image[1:], out=result[:-1])
    return result.swapaxes(0, axis)
