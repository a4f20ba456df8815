"""Figures as pages print them."""

import math

import pytest

from capture4d.app.report.metrics import shown


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (math.nan, "–"),
        (math.inf, "–"),
        (12.0, "12"),
        (1234.0, "1234"),
        (1234.5, "1.23e+03"),
        (0.12345, "0.123"),
        (3e7, "3e+07"),
    ],
)
def test_a_figure_is_short_and_a_count_is_whole(value: float | None, text: str) -> None:
    assert shown(value) == text
