"""Every stage as a function, by the name of its command: what `capture4d COMMAND` does, for Python.

Folders are named by paths; CAPTURE and WORK may also be handed over open, as `read_capture` and `open_work` return
them. Every function resumes what was stopped, refuses to go on with other settings unless told to `overwrite`, and
returns a `StageResult`. The number of workers never changes a result.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

from capture4d.captures.capture import Capture, read_capture
from capture4d.captures.work_folder import WorkFolder, open_work
from capture4d.runs.stage import StageResult
from capture4d.tracking.config import TrackingConfig
from registration.config import RegistrationConfig

__all__ = ["extract", "register", "report", "run", "track"]

Folder: TypeAlias = str | Path


# --- a take ------------------------------------------------------------------------------------------------------


def extract(
    capture: Capture | Folder,
    work: WorkFolder | Folder,
    *,
    learn_colours: bool = False,
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Cut the garment out of every scan by its colour, and find its painted borders: WORK/garment.

    Args:
        learn_colours: learn all colours from the scans, not only those that capture.json leaves open.
    """
    from capture4d.extraction.stage import ExtractionSettings
    from capture4d.extraction.stage import run as stage

    config = ExtractionSettings(learn_colours=learn_colours)
    return stage(_capture(capture), _path(work) / "garment", config, workers=workers, overwrite=overwrite)


def track(
    capture: Capture | Folder,
    work: WorkFolder | Folder,
    config: TrackingConfig | None = None,
    *,
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Track the body through every scan, its poses and one shape for the take: WORK/body."""
    from capture4d.tracking.stage import run as stage

    return stage(
        _capture(capture), _path(work) / "body", config or TrackingConfig(), workers=workers, overwrite=overwrite
    )


def register(
    capture: Capture | Folder,
    work: WorkFolder | Folder,
    config: RegistrationConfig | None = None,
    *,
    tracked: bool = False,
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Register the template to every frame whose garment `extract` has cut out: WORK/registration.

    Args:
        tracked: move the template with the body that `track` found, not with the poses that the capture brings.
    """
    from registration.stage import run as stage

    folder = _path(work)
    return stage(
        _capture(capture),
        folder / "garment",
        folder / "registration",
        config or RegistrationConfig(),
        body_folder=folder / "body" if tracked else None,
        workers=workers,
        overwrite=overwrite,
    )


def report(
    work: WorkFolder | Folder,
    *,
    capture: Capture | Folder | None = None,
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Draw the report of a registered capture or an animated garment: WORK/report; the result's path is its page.

    Args:
        capture: the capture, if it is not where it was when it was registered.
    """
    opened = work if isinstance(work, WorkFolder) else open_work(work)
    if opened.is_animated:
        from capture4d.app.report.animation import run as animation_report

        return animation_report(opened, workers=workers, overwrite=overwrite)
    from capture4d.app.report.take import run as take_report

    moved = None if capture is None else _capture(capture)
    return take_report(opened, capture=moved, workers=workers, overwrite=overwrite)


def run(
    capture: Capture | Folder,
    work: WorkFolder | Folder,
    config: RegistrationConfig | None = None,
    *,
    tracking: TrackingConfig | None = None,
    tracked: bool = False,
    draw: bool = True,
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Extract, track if need be, register, report. Stages that are complete cost seconds.

    Args:
        tracking: settings of `track`.
        tracked: track the body even if the capture brings poses.
        draw: False leaves the report out.
    Returns:
        The registration's result; its path is the page of the report, if that was drawn.
    """
    opened = _capture(capture)
    tracked = tracked or _needs_tracking(opened)
    if not tracked:
        _ = opened.poses  # what is wrong with it is said before the work, not after
    extract(opened, work, workers=workers, overwrite=overwrite)
    if tracked:
        track(opened, work, tracking, workers=workers, overwrite=overwrite)
    registered = register(opened, work, config, tracked=tracked, workers=workers, overwrite=overwrite)
    if not draw:
        return registered
    page = report(_path(work), capture=opened, workers=workers, overwrite=overwrite).path
    return replace(registered, path=page)


def _needs_tracking(capture: Capture) -> bool:
    """Whether the template is bound to a body of which the capture has no poses."""
    return capture.template.skin_weights is not None and not (capture.path / "poses.npz").is_file()


# --- folders -----------------------------------------------------------------------------------------------------


def _capture(capture: Capture | Folder) -> Capture:
    return capture if isinstance(capture, Capture) else read_capture(capture)


def _path(work: WorkFolder | Folder) -> Path:
    return work.path if isinstance(work, WorkFolder) else Path(work)
