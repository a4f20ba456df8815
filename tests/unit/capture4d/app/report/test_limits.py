from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from capture4d.app.report.limits import KNOWN_METRICS, Limit, broken_limits, parse_limits
from capture4d.errors import InputError
from capture4d.files.atomic import write_json


@given(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6))
def test_a_number_breaks_at_most_one_of_two_limits_and_its_own_none(value: float, number: float):
    above, below = (Limit("fit_mean_mm", number, side) for side in ("above", "below"))
    assert above.broken_by(value) + below.broken_by(value) == (value != number)


def test_what_was_not_measured_breaks_every_limit():
    for limit in parse_limits(["fit_mean_mm=1e9"], ["fit_mean_mm=-1e9"]):
        assert limit.broken_by(None)
        assert limit.broken_by(float("nan"))


def test_limits_are_told_by_option_and_may_be_given_twice():
    found = parse_limits(["fit_mean_mm=1", "fit_mean_mm=2"], ["covered_percent=90"])
    assert [(limit.option, limit.metric, limit.number) for limit in found] == [
        ("--fail-above", "fit_mean_mm", 1.0),
        ("--fail-above", "fit_mean_mm", 2.0),
        ("--fail-below", "covered_percent", 90.0),
    ]


@pytest.mark.parametrize("text", ["fit_mean_mm", "fit_mean_mm=", "fit_mean_mm=nan", "fit_mean_mm=inf", "=", ""])
def test_what_is_no_limit_is_said_with_an_example(text: str):
    with pytest.raises(InputError, match=r"--fail-below: expected METRIC=LIMIT such as frames_good_percent=95, found "):
        parse_limits([], [text])


@pytest.mark.parametrize(
    ("metric", "nearest"),
    [("fit_mean", "fit_mean_mm"), ("frames_god_percent", "frames_good_percent"), ("inside", "inside_body_percent")],
)
def test_the_nearest_names_are_told(metric: str, nearest: str):
    with pytest.raises(InputError) as fault:
        parse_limits([f"{metric}=1"])
    said = str(fault.value)
    assert said.startswith(f"--fail-above: no metric '{metric}'; the nearest are ")
    assert nearest in said
    assert len(said.splitlines()) == 1


def test_a_name_like_no_other_gets_all_of_them():
    with pytest.raises(InputError) as fault:
        parse_limits(["qqq=1"])
    assert all(name in str(fault.value) for name in KNOWN_METRICS)


def test_each_broken_limit_is_one_line(tmp_path: Path):
    values = {"fit_mean_mm": 0.7, "covered_percent": 98.0, "border_mean_mm": None}
    write_json(
        tmp_path / "report" / "metrics.json",
        {"metrics": [{"key": key, "value": value} for key, value in values.items()]},
    )
    limits = parse_limits(["fit_mean_mm=0.5", "covered_percent=99"], ["covered_percent=99", "border_mean_mm=0"])
    assert broken_limits(tmp_path, limits) == [
        "fit_mean_mm is 0.7, above the limit of 0.5",
        "covered_percent is 98, below the limit of 99",
        "border_mean_mm was not measured, which breaks the limit --fail-below 0",
    ]
    with pytest.raises(InputError, match=r"no metric 'joint_max_mm' in .*metrics\.json; "):
        broken_limits(tmp_path, parse_limits(["joint_max_mm=1"]))
