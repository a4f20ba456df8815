"""Measures whose value is known."""

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from wrinkles.normal_maps.metrics import angles, gradient_error, score, ssim, wrinkle_band


def waves(height: float, *, wavelength: float = 12.0, frames: int = 4, speed: float = 0.5) -> torch.Tensor:
    """Normals that lean by travelling waves, wavelength in texels."""
    row = torch.arange(96.0)
    phase = 2 * torch.pi * (row[None, :, None] / wavelength) + speed * torch.arange(frames)[:, None, None]
    lean = height * torch.sin(phase).expand(-1, -1, 96)
    return normalize(torch.stack([0 * lean, lean, torch.ones_like(lean)], dim=1), dim=1)


EVERYWHERE = torch.ones(4, 1, 96, 96, dtype=torch.bool)
FOLLOWING = torch.tensor([False, True, True, True])


def scored(maps: torch.Tensor, truth: torch.Tensor, valid: torch.Tensor = EVERYWHERE):
    return score(maps, truth, valid, mm_per_texel=4.0, consecutive=FOLLOWING)


def test_angles_are_right_down_to_none():
    z = torch.tensor([0.0, 0, 1]).reshape(1, 3, 1, 1)
    for degrees in (0.0, 0.01, 30.0, 90.0, 180.0):
        radians = np.radians(degrees)
        other = torch.tensor([np.sin(radians), 0, np.cos(radians)]).float().reshape(1, 3, 1, 1)
        assert angles(z, other).item() == pytest.approx(degrees, abs=1e-3)


def test_the_truth_scores_perfectly():
    truth = waves(0.3)
    perfect = scored(truth, truth)
    assert perfect.normal_error_deg == pytest.approx(0, abs=1e-3)
    assert perfect.wrinkle_energy_kept == pytest.approx(1)
    assert perfect.flicker_deg == pytest.approx(0, abs=1e-6)
    assert perfect.data == 0
    assert perfect.ssim == pytest.approx(1, abs=1e-5)
    assert perfect.gradient == 0
    assert perfect.temporal_texels > 4


def test_half_the_height_is_a_quarter_of_the_energy():
    kept = scored(waves(0.05), waves(0.1)).wrinkle_energy_kept
    assert kept == pytest.approx(0.25, abs=0.01)


def test_the_band_passes_folds_and_stops_noise_and_drape():
    def passed(wavelength_mm: float) -> float:
        maps = waves(0.1, wavelength=wavelength_mm / 4.0)
        return float(wrinkle_band(maps, EVERYWHERE, mm_per_texel=4.0)[:, 1, 24:72].square().mean())

    full = 0.1**2 / 2
    assert passed(40) > 0.75 * full
    assert passed(20) > 0.6 * full
    assert passed(300) < 0.05 * full


def test_flicker_is_movement_beyond_the_truth_s():
    still, moving = waves(0.2, speed=0.0), waves(0.2, speed=0.5)
    assert scored(moving, still).flicker_deg > 2
    assert scored(still, moving).flicker_deg < -2


def test_unknown_texels_do_not_count_anywhere():
    truth, maps = waves(0.3), waves(0.25)
    valid = EVERYWHERE.clone()
    valid[:, :, 40:60, 30:70] = False
    spoiled = torch.where(valid, maps, normalize(torch.randn(4, 3, 96, 96), dim=1))
    a, b = scored(maps, truth, valid), scored(spoiled, truth, valid)
    for name in (
        "normal_error_deg",
        "wrinkle_energy_kept",
        "flicker_deg",
        "data",
        "temporal_printed",
        "gradient",
        "ssim",
    ):
        assert getattr(a, name) == pytest.approx(getattr(b, name), rel=1e-4, abs=1e-5), name


def test_a_net_change_is_not_a_change_texel_by_texel():
    truth = waves(0.3, wavelength=12.0, speed=float(np.pi))
    moved = scored(truth, truth)
    assert moved.temporal_printed < 0.05 * moved.temporal_texels


def test_blur_lowers_similarity_and_gradients():
    truth, flat = waves(0.3), waves(0.0)
    assert ssim(flat, truth, EVERYWHERE) < 0.9
    assert gradient_error(flat, truth, EVERYWHERE) > gradient_error(waves(0.2), truth, EVERYWHERE) > 0
