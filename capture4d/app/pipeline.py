"""The stages in a row, as calls on folders."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from capture4d.errors import InputError
from capture4d.workdir import read_json
from registration.config import RegistrationConfig

__all__ = ["broken_limits", "parse_limits", "run_all", "run_demo", "run_report"]


def run_demo(output: Path, *, workers: int, overwrite: bool = False) -> Path:
    """Synthesise `output`/capture, then run everything on it; the path of the report."""
    from data_synth.config import PRESETS
    from data_synth.stage import run as synthesise

    synthesise(output / "capture", PRESETS["demo"], workers=workers, overwrite=overwrite)
    return run_all(output / "capture", output, RegistrationConfig(), workers=workers, overwrite=overwrite)


def run_all(capture: Path, output: Path, config: RegistrationConfig, *, workers: int, overwrite: bool = False) -> Path:
    """Extract, register, report; the path of the report. Stages that are complete cost seconds."""
    from capture4d.garment_stage import run as extract
    from registration.stage import run as register

    extract(capture, output / "garment", workers=workers, overwrite=overwrite)
    register(capture, output / "garment", output / "registration", config, workers=workers, overwrite=overwrite)
    return run_report(output, capture=capture, workers=workers, overwrite=overwrite)


def run_report(work: Path, *, capture: Path | None = None, workers: int = 1, overwrite: bool = False) -> Path:
    """Draw the report of a work folder; the path of its page."""
    from capture4d.app.report import run as report

    return report(work, capture=capture, workers=workers, overwrite=overwrite)


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
