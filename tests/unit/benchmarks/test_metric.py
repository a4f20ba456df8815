"""A gate that cannot fail is no gate."""

import json
from pathlib import Path

import pytest

from benchmarks.metric import Metric, broken_limits, write_metrics


@pytest.fixture
def baseline(tmp_path: Path) -> Path:
    path = tmp_path / "baseline.json"
    entries = {"fit_mm": {"value": 1.0, "tolerance": 0.1}, "ratio": {"value": 50.0, "tolerance": 0.2}}
    path.write_text(json.dumps({"case": entries}))
    return path


@pytest.mark.parametrize(
    ("fit", "ratio", "broken"),
    [
        (1.09, 41.0, []),
        (0.2, 90.0, []),
        (1.11, 41.0, ["fit_mm"]),
        (1.0, 39.0, ["ratio"]),
        (float("nan"), 50.0, ["fit_mm"]),
    ],
)
def test_a_metric_may_lose_its_tolerance_and_no_more(baseline: Path, fit: float, ratio: float, broken: list[str]):
    metrics = [Metric("fit_mm", fit, "mm"), Metric("ratio", ratio, "", "higher")]
    assert [line.split(":")[0] for line in broken_limits("case", metrics, baseline=baseline)] == broken


def test_a_metric_that_is_gone_breaks_the_gate(baseline: Path):
    assert broken_limits("case", [Metric("fit_mm", 1.0, "mm")], baseline=baseline) == ["ratio: expected, not measured"]


def test_a_benchmark_without_figures_breaks_the_gate(baseline: Path, tmp_path: Path):
    assert len(broken_limits("other", [], baseline=baseline)) == 1
    assert len(broken_limits("case", [], baseline=tmp_path / "none.json")) == 1


def test_what_is_not_a_number_is_null(tmp_path: Path):
    write_metrics(tmp_path / "out" / "m.json", [Metric("a", 1.5, "mm"), Metric("b", float("nan"))])
    assert json.loads((tmp_path / "out" / "m.json").read_text())["metrics"] == [
        {"key": "a", "value": 1.5, "unit": "mm", "better": "lower"},
        {"key": "b", "value": None, "unit": "", "better": "lower"},
    ]
