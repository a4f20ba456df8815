"""What a benchmark returns, and the committed figures it is held against."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

__all__ = ["Metric", "broken_limits", "write_metrics"]

BASELINE = Path(__file__).with_name("baseline.json")


@dataclass(frozen=True, slots=True)
class Metric:
    """One figure."""

    key: str
    value: float
    unit: str = ""
    better: Literal["lower", "higher"] = "lower"


def write_metrics(path: Path, metrics: Sequence[Metric]) -> None:
    """Write `{"metrics": [{"key", "value", "unit", "better"}, ...]}`; NaN, which JSON lacks, is null."""
    rows = [{**asdict(metric), "value": metric.value if math.isfinite(metric.value) else None} for metric in metrics]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"metrics": rows}, indent=2) + "\n")


def broken_limits(name: str, metrics: Sequence[Metric], *, baseline: Path = BASELINE) -> list[str]:
    """One line for each metric that is worse than the committed baseline allows, or is not measured any more.

    The baseline maps a benchmark's name (with `-quick` for the quick case) to `{key: {"value": v, "tolerance": t}}`,
    where t is the relative loss that is still noise. A benchmark without an entry fails: a gate that holds nothing is
    no gate.
    """
    committed: Mapping[str, Mapping[str, Any]] = json.loads(baseline.read_text()) if baseline.is_file() else {}
    if not committed.get(name):
        return [f"{name}: no figures in {baseline.name}"]
    measured = {metric.key: metric for metric in metrics}
    broken = []
    for key, entry in committed[name].items():
        metric = measured.get(key)
        if metric is None:
            broken.append(f"{key}: expected, not measured")
            continue
        slack = abs(entry["value"]) * entry["tolerance"]
        limit = entry["value"] + (slack if metric.better == "lower" else -slack)
        holds = metric.value <= limit if metric.better == "lower" else metric.value >= limit
        if not holds:  # NaN holds nothing
            sign = "<=" if metric.better == "lower" else ">="
            broken.append(f"{key}: expected {sign} {limit:.4g} {metric.unit}, measured {metric.value:.4g}")
    return broken
