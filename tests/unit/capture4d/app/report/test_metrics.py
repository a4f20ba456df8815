"""Figures as pages print them, and what they are of a take."""

import math

import pytest

from capture4d.app.report.metrics import region_rows, shown, summarise


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


def frame(frame_id: int, **changes: float) -> dict:
    return {"frame_id": frame_id, "verdict": "good", "cpu_s": 0.1, **changes}


def test_the_farthest_vertex_is_that_of_the_take_and_other_measures_are_means() -> None:
    records = [
        frame(0, fit_max_mm=1.0, fit_p99_mm=1.0, joint_max_mm=2.0),
        frame(1, fit_max_mm=7.0, fit_p99_mm=3.0, joint_max_mm=4.0),
    ]
    summary = summarise(records)
    assert summary["fit_max_mm"] == 7.0
    assert summary["fit_p99_mm"] == 2.0
    assert summary["joint_max_mm"] == 3.0, "of a frame"


def test_a_region_is_told_by_its_usual_fit_and_its_worst_frame() -> None:
    def region(**changes: float | None) -> dict:
        return {"fit_p95_mm": 0.2, "fit_max_mm": 1.0, "fit_beyond_percent": 0.0, "cut_percent": 0.0,
                "creased_percent": 1.0, "covered_percent": 90.0, **changes}  # fmt: skip

    records = [
        frame(0) | {"regions": {"hem": region()}},
        frame(1) | {"regions": {"hem": region(fit_p95_mm=0.4, cut_percent=9.0, covered_percent=60.0, fit_max_mm=None)}},
        frame(2),  # of an earlier version
    ]
    hem = region_rows(records)["hem"]
    assert hem["fit_p95_mm"] == pytest.approx(0.3)
    assert (hem["cut_percent"], hem["covered_percent"], hem["fit_max_mm"]) == (9.0, 60.0, 1.0)
    assert region_rows(records[2:]) == {}
