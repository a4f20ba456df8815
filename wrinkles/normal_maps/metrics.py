"""How good a high-resolution map is. Everything takes unit normals, channels first, and masks; kornia where it can.

normal error      angle to the reference over known texels, degrees
wrinkle energy    of the band of fold wavelengths, relative to the reference: 1 is as much wrinkle as the truth
flicker           angle between consecutive maps, less the same of the reference, degrees
Data, Temporal    DeepWrinkles' Table 1 on values 0 to 255: as Eq. 4 prints it (net change), and texel by texel
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

__all__ = ["MapScores", "angles", "gradient_error", "score", "ssim", "wrinkle_band"]

Maps = Float[Tensor, "frames 3 height width"]
Masks = Bool[Tensor, "frames 1 height width"]

BAND_MM = (1.5, 15.0)
"""Standard deviations of the blurs whose difference is the wrinkle band: it passes wavelengths of 10 to 90 mm."""
HALF_RANGE = 127.5
"""A normal component from -1 to 1 is a value from 0 to 255."""


@dataclass(frozen=True, slots=True)
class MapScores:
    """Of a sequence of maps against its reference, in the units of the module's docstring."""

    normal_error_deg: float
    wrinkle_energy_kept: float
    flicker_deg: float
    data: float
    temporal_printed: float
    """Net change of a channel against the true map of the frame before."""
    temporal_texels: float
    """The same, texel by texel."""
    ssim: float
    gradient: float


def score(
    maps: Maps, truth: Maps, valid: Masks, *, mm_per_texel: float, consecutive: Bool[Tensor, " frames"]
) -> MapScores:
    """All measures.

    Args:
        consecutive: frames that directly follow the one before in the sequence; the first never does.
    """
    after = consecutive.nonzero().flatten()
    before = after - 1
    both = valid[after] & valid[before]
    moved = _mean(angles(maps[after], maps[before]), both)
    truly_moved = _mean(angles(truth[after], truth[before]), both)
    change = HALF_RANGE * (maps[after] - truth[before])
    count = both.sum(dim=(2, 3)).clamp(min=1)
    net = ((change * both).sum(dim=(2, 3)) / count).abs()
    return MapScores(
        normal_error_deg=_mean(angles(maps, truth), valid),
        wrinkle_energy_kept=_energy(maps, valid, mm_per_texel) / max(_energy(truth, valid, mm_per_texel), 1e-12),
        flicker_deg=moved - truly_moved,
        data=_mean(HALF_RANGE * (maps - truth).abs().mean(dim=1, keepdim=True), valid),
        temporal_printed=float(net.mean()) if len(after) else float("nan"),
        temporal_texels=_mean(change.abs().mean(dim=1, keepdim=True), both),
        ssim=ssim(maps, truth, valid),
        gradient=gradient_error(maps, truth, valid),
    )


def angles(a: Maps, b: Maps) -> Float[Tensor, "frames 1 height width"]:
    """Between unit normals, degrees; exact for small angles too."""
    half = (a - b).norm(dim=1, keepdim=True) / 2
    return torch.rad2deg(2 * torch.asin(half.clamp(max=1)))


def wrinkle_band(maps: Maps, valid: Masks, *, mm_per_texel: float) -> Maps:
    """What lies between the two blurs of `BAND_MM`; texels beyond the mask do not bleed in."""
    fine, coarse = (_blurred(maps, valid, sigma / mm_per_texel) for sigma in BAND_MM)
    return (fine - coarse) * valid


def ssim(maps: Maps, truth: Maps, valid: Masks) -> float:
    """Mean structural similarity over known texels."""
    from kornia.metrics import ssim as similarity

    per_texel = similarity((maps * valid + 1) / 2, (truth * valid + 1) / 2, window_size=11)
    return _mean(per_texel.mean(dim=1, keepdim=True), valid)


def gradient_error(maps: Maps, truth: Maps, valid: Masks) -> float:
    """Mean length of the difference of spatial gradients (Sobel), over texels whose neighbours are known."""
    from kornia.filters import spatial_gradient
    from kornia.morphology import erosion

    inner = erosion(valid.float(), torch.ones(3, 3)) > 0.5
    difference = spatial_gradient(maps) - spatial_gradient(truth)
    return _mean(difference.flatten(1, 2).norm(dim=1, keepdim=True), inner)


def _energy(maps: Tensor, valid: Tensor, mm_per_texel: float) -> float:
    return float(wrinkle_band(maps, valid, mm_per_texel=mm_per_texel).square().sum() / valid.sum().clamp(min=1))


def _blurred(maps: Tensor, valid: Tensor, sigma: float) -> Tensor:
    from kornia.filters import gaussian_blur2d

    side = 2 * max(int(3 * sigma + 0.5), 1) + 1
    weight = gaussian_blur2d(valid.float(), (side, side), (sigma, sigma), border_type="constant")
    return gaussian_blur2d(maps * valid, (side, side), (sigma, sigma), border_type="constant") / weight.clamp(min=1e-6)


def _mean(values: Tensor, mask: Tensor) -> float:
    return float((values * mask).sum() / mask.sum()) if mask.any() else float("nan")
