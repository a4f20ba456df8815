"""Light and its encodings: there and back, and how far the power is from the curve."""

import numpy as np

from capture4d.colours.spaces import encode_colours, linear_colours, nearly_encoded, nearly_linear

LEVELS = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)


def test_colours_survive_the_way_to_light_and_back() -> None:
    np.testing.assert_array_equal(encode_colours(linear_colours(LEVELS)), LEVELS)
    np.testing.assert_allclose(nearly_encoded(nearly_linear(LEVELS / 255.0)), LEVELS / 255.0, atol=1e-12)


def test_the_curve_is_the_standards_and_the_power_is_near_it() -> None:
    # IEC 61966-2-1: level 10 is on the straight part, 118 is the usual middle grey of 18 %.
    np.testing.assert_allclose(linear_colours(LEVELS)[[10, 118], 0], [10 / 255 / 12.92, 0.1812], atol=2e-4)
    assert 0.005 < np.abs(linear_colours(LEVELS) - nearly_linear(LEVELS / 255.0)).max() < 0.009
