"""The stages in a row, as calls on folders."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from capture4d.errors import InputError
from capture4d.files.atomic import read_json
from capture4d.tracking.config import TrackingConfig
from registration.config import RegistrationConfig
from retarget.config import AnimateConfig, FitConfig, TrainingConfig

__all__ = ["broken_limits", "needs_tracking", "parse_limits", "run_all", "run_demo", "run_report", "run_stages"]


BOARD_POSES = 16
"""Of the board that the demo calibrates with."""
WRINKLE_STEPS = 500
"""Of the small network: it shows how wrinkles are learned; good ones take thousands of steps and frames."""
HELD_OUT = 0.15
"""Share of the demo's frames that the network does not see."""
OTHER_PERSON = (1.5, 2.0)
"""Whom the demo puts the garment on: taller and heavier than the captured subject."""


def run_demo(output: Path, *, workers: int, overwrite: bool = False) -> tuple[Path, Path]:
    """Synthesise `output`/capture, calibrate its rig from photographs of a board, run everything on the scans, the true
    poses left aside, learn the garment and its wrinkles, compare what was learned, and put the garment on another body;
    the paths of the two reports."""
    from capture4d.app.compare.config import CompareConfig
    from capture4d.app.compare.page import run as compare
    from data_synth.config import PRESETS
    from data_synth.stage import run as synthesise
    from retarget.animation.stage import run as animate
    from retarget.fit_stage import run as fit
    from wrinkles.normal_maps.config import PRESETS as WRINKLES
    from wrinkles.normal_maps.train_stage import run as train_wrinkles

    synthesise(output / "capture", PRESETS["demo"], workers=workers, overwrite=overwrite)
    _calibrate_demo(output / "capture" / "rig.json", output / "rig", workers=workers, overwrite=overwrite)
    run_stages(output / "capture", output, RegistrationConfig(), track=True, workers=workers, overwrite=overwrite)
    quick = TrainingConfig(epochs=60, patience=20)
    fit([output], output / "retarget", FitConfig(training=quick), workers=workers, overwrite=overwrite)
    network = WRINKLES["small"]
    network = replace(network, held_out=HELD_OUT, schedule=replace(network.schedule, steps=WRINKLE_STEPS))
    train_wrinkles([output], output / "wrinkles" / "model", network, workers=workers, overwrite=overwrite)
    small = CompareConfig(held_out=HELD_OUT, image_texels=128, epochs=60)
    compare(output, output / "wrinkles" / "model", small, workers=workers, overwrite=overwrite)
    report = run_report(output, capture=output / "capture", workers=workers, overwrite=overwrite)
    animate(
        output / "retarget",
        output / "body" / "poses.npz",
        output / "other",
        AnimateConfig(),
        beta=OTHER_PERSON,
        workers=workers,
        overwrite=overwrite,
    )
    return report, run_report(output / "other", workers=workers, overwrite=overwrite)


def _calibrate_demo(truth: Path, folder: Path, *, workers: int, overwrite: bool) -> None:
    """Photograph a board with the true rig, and calibrate from the photographs alone."""
    from capture4d.app.report.calibration import write_page
    from capture4d.calibration.stage import run as calibrate
    from data_synth.board.stage import run as photograph
    from data_synth.config import BoardConfig

    config = BoardConfig(poses=BOARD_POSES)
    photograph(truth, folder / "board", config, workers=workers, overwrite=overwrite)
    if overwrite or not (folder / "calibration.html").is_file():
        report = calibrate(folder / "board", folder / "rig.json", config.board, workers=workers)
        write_page(folder / "calibration.html", report)


def run_all(
    capture: Path,
    output: Path,
    config: RegistrationConfig,
    *,
    tracking: TrackingConfig | None = None,
    track: bool = False,
    workers: int,
    overwrite: bool = False,
) -> Path:
    """Extract, track if need be, register, report; the path of the report. Stages that are complete cost seconds.

    Args:
        track: track the body even if the capture brings poses.
    """
    run_stages(capture, output, config, tracking=tracking, track=track, workers=workers, overwrite=overwrite)
    return run_report(output, capture=capture, workers=workers, overwrite=overwrite)


def run_stages(
    capture: Path,
    output: Path,
    config: RegistrationConfig,
    *,
    tracking: TrackingConfig | None = None,
    track: bool = False,
    workers: int,
    overwrite: bool = False,
) -> None:
    """The same without the report."""
    from capture4d.captures.capture import read_capture, read_poses, read_template
    from capture4d.extraction.stage import run as extract
    from registration.stage import run as register

    description = read_capture(capture)
    read_template(description)  # what is wrong with it is said before the work, not after
    if not track:
        read_poses(description)
    extract(capture, output / "garment", workers=workers, overwrite=overwrite)
    body_folder = None
    if track or needs_tracking(capture):
        from capture4d.tracking.stage import run as track_body

        body_folder = output / "body"
        track_body(capture, body_folder, tracking or TrackingConfig(), workers=workers, overwrite=overwrite)
    register(
        capture,
        output / "garment",
        output / "registration",
        config,
        body_folder=body_folder,
        workers=workers,
        overwrite=overwrite,
    )


def needs_tracking(capture: Path) -> bool:
    """Whether the template is bound to a body of which the capture has no poses."""
    from capture4d.captures.capture import read_capture, read_template

    description = read_capture(capture)
    return not (capture / "poses.npz").is_file() and read_template(description).skin_weights is not None


def run_report(work: Path, *, capture: Path | None = None, workers: int = 1, overwrite: bool = False) -> Path:
    """Draw the report of a work folder; the path of its page."""
    from capture4d.captures.work_folder import is_animated

    if is_animated(work):
        from capture4d.app.report.animation import run as report_animation

        return report_animation(work, workers=workers, overwrite=overwrite)
    from capture4d.app.report.take import run as report

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
