"""Limits for the metrics of a report: what makes a CI job fail."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from capture4d.errors import InputError
from capture4d.files.atomic import read_json

__all__ = ["broken_limits", "parse_limits"]


def parse_limits(texts: Sequence[str]) -> dict[str, float]:
    """`["fit_mean_mm=1.0"]` as a mapping.

    Raises:
        InputError: a text is not METRIC=NUMBER.
    """
    limits = {}
    for text in texts:
        key, _, number = text.partition("=")
        try:
            limits[key] = float(number)
        except ValueError:
            raise InputError(f"--fail-above: expected METRIC=LIMIT such as fit_mean_mm=1.0, found '{text}'") from None
    return limits


def broken_limits(work: Path, limits: Mapping[str, float]) -> list[str]:
    """One line for each metric of `work`/report/metrics.json above its limit; NaN and null break every limit.

    Raises:
        InputError: there is no such metric.
    """
    path = work / "report" / "metrics.json"
    metrics = {entry["key"]: entry["value"] for entry in read_json(path)["metrics"]} if limits else {}
    broken = []
    for key, limit in limits.items():
        if key not in metrics:
            raise InputError(f"--fail-above: no metric '{key}' in {path}, it has {', '.join(metrics)}")
        value = metrics[key]
        if value is None or not value <= limit:
            broken.append(f"{key} is {value}, above the limit of {limit:g}")
    return broken
