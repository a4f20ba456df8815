"""From a capture to a registered garment: rig, template, and the stages of a take."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from capture4d.app.status.work_folders import changes, made_anew, needs_tracking
from capture4d.calibration.config import CalibrationConfig, RigCheckConfig
from capture4d.captures.work_folder import AnyCapture, AnyWork, Place, opened_capture, opened_work, path_of
from capture4d.runs.decisions import forget_decisions, take_over_decisions
from capture4d.runs.processes.pool import kept_workers
from capture4d.runs.run_log import logged_stage
from capture4d.runs.stage import StageResult
from capture4d.steps.presets import chosen
from capture4d.templates.config import TemplateConfig
from capture4d.tracking.config import TrackingConfig
from registration.config import PRESETS, MeshRegistrationConfig, RegistrationConfig

if TYPE_CHECKING:
    from capture4d.calibration.check import CameraCheck
    from capture4d.calibration.stage import CalibrationResult
    from capture4d.preflight.check import Checked
    from capture4d.preflight.take_folder import Claims
    from capture4d.templates.stage import TemplateResult
    from registration.register_mesh import MeshRegistration

__all__ = [
    "calibrate", "check", "check_rig", "extract", "register", "register_mesh", "renew", "report", "run", "take_over",
    "template", "track",
]  # fmt: skip


@logged_stage("extract")
def extract(
    capture: AnyCapture, work: AnyWork, *, learn_colours: bool = False, for_tracking: bool | None = None,
    workers: int = 1, overwrite: bool = False,
) -> StageResult:  # fmt: skip
    """Cut the garment out of every scan by its colour, and find its painted borders: WORK/garment.

    Args:
        learn_colours: learn all colours from the scans, not only those that capture.json leaves open.
        for_tracking: keep what `track` reads of each scan, so that it need not open them; None: if the capture brings
            no poses.
    """
    from capture4d.extraction.stage import ExtractionSettings
    from capture4d.extraction.stage import run as stage

    return stage(
        opened_capture(capture), path_of(work) / "garment", ExtractionSettings(learn_colours=learn_colours),
        workers=workers, overwrite=overwrite, for_tracking=for_tracking,
    )  # fmt: skip


@logged_stage("track")
def track(
    capture: AnyCapture,
    work: AnyWork,
    config: TrackingConfig | None = None,
    *,
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Track the body through every scan, its poses and one shape for the take: WORK/body."""
    from capture4d.tracking.stage import run as stage

    config = config or TrackingConfig()
    return stage(opened_capture(capture), path_of(work) / "body", config, workers=workers, overwrite=overwrite)


@logged_stage("register")
def register(
    capture: AnyCapture,
    work: AnyWork,
    config: RegistrationConfig | str | None = None,
    *,
    tracked: bool = False,
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Register the template to every frame whose garment `extract` has cut out: WORK/registration.

    Args:
        config: settings, or the name of a preset.
        tracked: move the template with the body that `track` found, not with the poses that the capture brings.
    """
    from registration.stage import run as stage

    folder = path_of(work)
    return stage(
        opened_capture(capture), folder / "garment", folder / "registration", chosen(config, PRESETS),
        body_folder=folder / "body" if tracked else None, workers=workers, overwrite=overwrite,
    )  # fmt: skip


@logged_stage("report")
def report(
    work: AnyWork, *, capture: AnyCapture | None = None, workers: int = 1, overwrite: bool = False
) -> StageResult:
    """Draw the report of a registered capture or an animated garment: WORK/report; the result's path is its page.

    Args:
        capture: the capture, if it is not where it was when it was registered.
    """
    opened = opened_work(work)
    if opened.is_animated:
        from capture4d.app.report.animation import run as animation_report

        return animation_report(opened, workers=workers, overwrite=overwrite)
    from capture4d.app.report.take import run as take_report

    moved = None if capture is None else opened_capture(capture)
    return take_report(opened, capture=moved, workers=workers, overwrite=overwrite)


def run(
    capture: AnyCapture,
    work: AnyWork,
    config: RegistrationConfig | str | None = None,
    *,
    tracking: TrackingConfig | None = None,
    tracked: bool = False,
    draw: bool = True,
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Extract, track if need be, register, report. Stages that are complete cost seconds.

    Args:
        config: settings of `register`, or the name of a preset.
        tracking: settings of `track`.
        tracked: track the body even if the capture brings poses.
        draw: False leaves the report out.
        overwrite: begin anew with the first stage whose settings have changed; with the first of all if none have.
    Returns:
        The registration's result; its path is the page of the report, if that was drawn.
    """
    from capture4d.preflight.readiness import require_ready

    opened, folder = opened_capture(capture), path_of(work)
    config, tracking = chosen(config, PRESETS), tracking or TrackingConfig()
    tracked = tracked or needs_tracking(opened)
    require_ready(opened, folder, config, tracking if tracked else None, anew=overwrite)
    anew = made_anew(changes(opened, folder, config, tracking=tracking, tracked=tracked)) if overwrite else ()
    with kept_workers():
        extract(opened, folder, for_tracking=tracked, workers=workers, overwrite="extract" in anew)
        if tracked:
            track(opened, folder, tracking, workers=workers, overwrite="track" in anew)
        registered = register(opened, folder, config, tracked=tracked, workers=workers, overwrite="register" in anew)
        if not draw:
            return registered
        page = report(folder, capture=opened, workers=workers, overwrite=overwrite).path
    return replace(registered, path=page)


def renew(work: AnyWork, what: Collection[str]) -> None:
    """Let the next run find anew what the whole take decides, and is kept otherwise: "shape", "colours".

    Raises:
        InputError: it decides no such thing.
    """
    forget_decisions(path_of(work), what)


def take_over(work: AnyWork, like: AnyWork) -> None:
    """Let the stages of a take go by the shape and the learned colours of another, instead of finding their own.

    Args:
        work: folder in which nothing has been tracked and extracted yet.
        like: work folder of a take of the same person, in the same clothes.
    """
    take_over_decisions(path_of(work), path_of(like))


@logged_stage("calibrate")
def calibrate(
    images: Place,
    output: Place,
    board: str,
    config: CalibrationConfig | None = None,
    *,
    pattern: str = "{camera}/{pose}",
    colmap: Place | None = None,
    workers: int = 1,
    overwrite: bool = False,
) -> CalibrationResult:
    """Calibrate a camera rig from images of a ChArUco board: rig.json, calibration.json and calibration.html.

    Args:
        output: rig.json to write; the others go beside it.
        board: charuco:COLUMNSxROWS:SQUARE_MM:MARKER_MM:DICTIONARY.
        pattern: how the images lie in the folder, without their ending.
        colmap: folder for the rig as a COLMAP model as well.
    """
    from capture4d.app.report.calibration import write_page
    from capture4d.calibration.stage import run as stage

    result = stage(
        Path(images), Path(output), board, config or CalibrationConfig(),
        pattern=pattern, colmap=_maybe(colmap), workers=workers, overwrite=overwrite,
    )  # fmt: skip
    write_page(Path(output).with_name("calibration.html"), result.report)
    return result


def check_rig(
    rig: Place,
    images: Place,
    config: RigCheckConfig | None = None,
    *,
    board: str | None = None,
    pattern: str = "{camera}/{pose}",
    workers: int = 1,
) -> list[CameraCheck]:
    """Tell of each camera whether it has moved since calibration, from one pose of the board.

    Args:
        board: if it is not the one of the calibration.json beside the rig.
    """
    from capture4d.calibration.stage import run_check

    config = config or RigCheckConfig()
    return run_check(Path(rig), Path(images), config, board=board, pattern=pattern, workers=workers)


def check(
    capture: Place, output: Place | None = None, claims: Claims | None = None, *, all_frames: bool = False,
    workers: int = 1,
) -> Checked:  # fmt: skip
    """Look through a take before a night is spent on it: `.verdict.findings`, worst first.

    Args:
        capture: capture folder, or just a folder of scans.
        output: folder for a corrected take, if anything has to be corrected; looks at every frame.
        claims: what is said of the take, over what its folder says.
    """
    from capture4d.preflight.stage import run as stage

    return stage(Path(capture), _maybe(output), claims, all_frames=all_frames, workers=workers)


def template(
    mesh: Place | None,
    output: Place,
    config: TemplateConfig | None = None,
    *,
    body: Place | None = None,
    poses: Place | None = None,
    cage: Place | None = None,
    overwrite: bool = False,
) -> TemplateResult:
    """Make a template of a garment mesh, or of a part of the body: bound, its borders named, its UVs checked.

    Args:
        mesh: garment that lies on the body; None where `config` names a region of the body.
        body: the body it lies on, a body.npz; the built-in one if None.
        poses: motion file with the pose and the shape in which it lies there; the rest pose if None.
        cage: curves along which `config.wrap` shrinks the mesh onto the body, .npy or .json; found if None.
        overwrite: write it over a file that holds something else.
    """
    from capture4d.files.outputs import new_files
    from capture4d.templates.stage import run as stage

    given, place = [_maybe(path) for path in (mesh, body, poses, cage)], Path(output)
    with new_files([place], inputs=given, overwrite=overwrite) as workshop:
        result = stage(
            given[0], workshop / place.name, config or TemplateConfig(), body=given[1], poses=given[2], cage=given[3]
        )
    return replace(result, path=place)


def register_mesh(
    template: Place,
    scan: Place,
    output: Place,
    config: MeshRegistrationConfig | None = None,
    *,
    landmarks: Place | None = None,
    overwrite: bool = False,
) -> MeshRegistration:
    """Register one mesh file to another, by a file of landmarks if given; `capture4d.register_mesh` takes arrays."""
    from capture4d.extraction.garment import painted_border
    from registration.register_mesh import run as stage

    given, config = (Path(template), Path(scan), Path(output)), config or MeshRegistrationConfig()
    marks = _maybe(landmarks)
    return stage(*given, config, landmarks_path=marks, find_border=painted_border, overwrite=overwrite)


def _maybe(place: Place | None) -> Path | None:
    return None if place is None else Path(place)
