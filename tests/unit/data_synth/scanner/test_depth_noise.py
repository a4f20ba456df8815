import numpy as np
import pytest

from data_synth.scanner.config import NoiseConfig
from data_synth.scanner.depth_noise import corrupt_depth, draw_noise_fields, periodic_gaussian_field, silhouettes

NO_LOSS = NoiseConfig(lost_cosine=0.0, weak_cosine=0.0, blob_loss=0.0)


def corrupted(depth, cosine, config, seed=0):
    rng = np.random.default_rng(seed)
    fields = draw_noise_fields(config, rng, largest_image=256, period=512)
    return corrupt_depth(depth, cosine, fields, config=config, rng=rng)


@pytest.mark.parametrize("sigma", [0.0, 2.0, 5.0])
def test_fields_have_the_autocorrelation_of_blurred_noise(sigma):
    field = periodic_gaussian_field(512, sigma, np.random.default_rng(0))
    assert field.std() == pytest.approx(1, abs=1e-3)
    for shift in (1, 3, 6):
        expected = np.exp(-(shift**2) / (4 * sigma**2)) if sigma else 0.0
        assert np.mean(field * np.roll(field, shift, axis=0)) == pytest.approx(expected, abs=0.05)


def test_noise_grows_with_the_square_of_depth_and_with_the_grazing_angle():
    flat, ones = np.full((256, 256), 1.5, np.float32), np.ones((256, 256), np.float32)
    near = (corrupted(flat, ones, NO_LOSS) - flat)[4:-4, 4:-4].std()
    assert near == pytest.approx(NO_LOSS.sigma_m, rel=0.1)
    assert (corrupted(2 * flat, ones, NO_LOSS) - 2 * flat)[4:-4, 4:-4].std() == pytest.approx(4 * near, rel=0.02)
    assert (corrupted(flat, ones / 2, NO_LOSS) - flat)[4:-4, 4:-4].std() == pytest.approx(2 * near, rel=0.02)


def test_both_sides_of_a_step_are_lost_and_a_slope_is_kept():
    depth = np.full((64, 64), 1.0, np.float32)
    depth[:, 32:] = 1.1
    edge = silhouettes(depth, 0.012)
    assert edge[:, 31:33].all()
    assert not edge[:, :31].any()
    assert not edge[:, 33:].any()
    slope = np.broadcast_to(1 + 0.005 * np.arange(64, dtype=np.float32), (64, 64))
    assert not silhouettes(slope, 0.012).any()


def test_lost_shares():
    config = NoiseConfig(blob_loss=0.1, weak_loss=0.4)
    flat = np.full((256, 256), 1.5, np.float32)
    assert not corrupted(flat, np.full_like(flat, 0.1), config).any()
    lost = np.mean([(corrupted(flat, np.full_like(flat, 0.3), config, seed) == 0).mean() for seed in range(8)])
    assert lost == pytest.approx(0.5, abs=0.06)
    lost = np.mean([(corrupted(flat, np.ones_like(flat), config, seed) == 0).mean() for seed in range(8)])
    assert lost == pytest.approx(0.1, abs=0.03)


def test_nothing_appears_where_there_is_nothing():
    depth = np.zeros((64, 64), np.float32)
    assert not corrupted(depth, depth, NoiseConfig()).any()
