"""The benchmark runner: what CI calls by name has to be there."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.__main__ import baseline_name, main
from benchmarks.metric import Metric, broken_limits


def test_the_list_names_every_benchmark_and_each_has_quick_figures_to_hold(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--list"]) == 0
    names = capsys.readouterr().out.split()
    assert {"registration", "resume", "synthesis"} <= set(names)
    committed = json.loads((Path(__file__).parents[3] / "benchmarks" / "baseline.json").read_text())
    for name in names:
        assert committed[f"{name}-quick"], f"--gate holds nothing for {name}"


def test_an_unknown_benchmark_is_a_usage_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["nonsense"]) == 2
    assert "NAME is one of" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "entry"),
    [
        ([], "case"),
        (["--quick"], "case-quick"),
        (["--data", "diffcloth"], "case-diffcloth"),
        (["--data=diffcloth", "--quick"], "case-diffcloth-quick"),
        (["--quick", "--data", "synth"], "case-quick"),
    ],
)
def test_other_data_is_held_to_figures_of_its_own(options: list[str], entry: str) -> None:
    def run(*, quick: bool = False, data: str = "synth") -> list[Metric]:
        return []

    assert baseline_name("case", run, options) == entry


@pytest.mark.parametrize(
    ("value", "better", "holds"),
    [(1.2, "lower", True), (1.3, "lower", False), (0.8, "higher", True), (0.7, "higher", False)],
)
def test_the_gate_allows_the_tolerance_and_no_more(tmp_path: Path, value: float, better, holds: bool) -> None:
    baseline = tmp_path / "baseline.json"
    baseline.write_text(json.dumps({"case": {"key": {"value": 1.0, "tolerance": 0.25}}}))
    broken = broken_limits("case", [Metric("key", value, "", better)], baseline=baseline)
    assert bool(broken) != holds


def test_a_figure_that_is_no_longer_measured_breaks_the_gate(tmp_path: Path) -> None:
    baseline = tmp_path / "baseline.json"
    baseline.write_text(json.dumps({"case": {"key": {"value": 1.0, "tolerance": 0.25}}}))
    assert broken_limits("case", [], baseline=baseline) == ["key: expected, not measured"]
    assert broken_limits("other", [], baseline=baseline)
