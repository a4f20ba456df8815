"""Limits for the metrics of a report: what makes a CI job fail."""

from __future__ import annotations

import difflib
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from capture4d.app.report.animation import ANIMATION_METRICS
from capture4d.app.report.metrics import METRICS
from capture4d.errors import InputError
from capture4d.files.atomic import read_json

__all__ = ["KNOWN_METRICS", "Limit", "broken_among", "broken_limits", "parse_limits", "parse_numbers", "unknown_metric"]

KNOWN_METRICS = tuple(dict.fromkeys((*METRICS, *ANIMATION_METRICS)))
"""Of reports of takes and of animated garments."""
_NEAREST = 3


@dataclass(frozen=True, slots=True)
class Limit:
    """A metric that has to stay on one side of a number; the number itself will do."""

    metric: str
    number: float
    side: Literal["above", "below"]
    """Where the metric must not be."""

    @property
    def option(self) -> str:
        return f"--fail-{self.side}"

    def broken_by(self, value: float | None) -> bool:
        """Whether a value lies beyond; one that is missing or no number does."""
        if value is None or math.isnan(value):
            return True
        return value > self.number if self.side == "above" else value < self.number


def parse_limits(above: Sequence[str] = (), below: Sequence[str] = ()) -> list[Limit]:
    """`["fit_mean_mm=1.0"]` and `["covered_percent=90"]` as limits.

    Raises:
        InputError: a text is not METRIC=NUMBER, or no report has such a metric.
    """
    told: tuple[tuple[Literal["above", "below"], Sequence[str], str], ...] = (
        ("above", above, "fit_mean_mm=1.0"),
        ("below", below, "frames_good_percent=95"),
    )
    return [
        Limit(metric, number, side)
        for side, texts, example in told
        for metric, number in parse_numbers(texts, f"--fail-{side}", f"METRIC=LIMIT such as {example}")
    ]


def parse_numbers(texts: Sequence[str], option: str, expected: str) -> list[tuple[str, float]]:
    """`["fit_mean_mm=1.0"]` as pairs of a metric and a finite number.

    Raises:
        InputError: a text is nothing of the kind, or names no metric; the message begins with the option.
    """
    pairs = []
    for text in texts:
        metric, _, written = text.partition("=")
        try:
            number = float(written)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise InputError(f"{option}: expected {expected}, found '{text}'")
        if metric not in KNOWN_METRICS:
            raise unknown_metric(option, metric, KNOWN_METRICS)
        pairs.append((metric, number))
    return pairs


def unknown_metric(option: str, metric: str, known: Collection[str], *, where: str = "") -> InputError:
    """What is said of a metric that is not there: those whose names are nearest, or where to find all of them.

    Args:
        where: whose metrics these are, as in " in work/report/metrics.json".
    """
    near = difflib.get_close_matches(metric, known, n=_NEAREST, cutoff=0.5)
    alike = [name for name in known if metric and metric in name]
    names = list(dict.fromkeys([*near, *alike]))[:_NEAREST]
    said = f"the nearest are {', '.join(names)}" if names else f"there are {', '.join(known)}"
    return InputError(f"{option}: no metric '{metric}'{where}; {said}")


def broken_limits(work: Path, limits: Sequence[Limit]) -> list[str]:
    """One line for each limit that `work`/report/metrics.json breaks; NaN and null break every limit.

    Raises:
        InputError: this report has no such metric.
    """
    path = work / "report" / "metrics.json"
    metrics = {entry["key"]: entry["value"] for entry in read_json(path)["metrics"]} if limits else {}
    return broken_among(metrics, limits, where=path)


def broken_among(metrics: Mapping[str, float | None], limits: Sequence[Limit], *, where: Path) -> list[str]:
    """The same of metrics that are known.

    Args:
        where: the file that holds them.
    """
    broken = []
    for limit in limits:
        if limit.metric not in metrics:
            raise unknown_metric(limit.option, limit.metric, metrics, where=f" in {where}")
        value = metrics[limit.metric]
        if limit.broken_by(value):
            broken.append(_said(limit, value))
    return broken


def _said(limit: Limit, value: float | None) -> str:
    if value is None or math.isnan(value):
        return f"{limit.metric} was not measured, which breaks the limit {limit.option} {limit.number:g}"
    return f"{limit.metric} is {value:.6g}, {limit.side} the limit of {limit.number:g}"
