"""Work folders from outside: what a run would do, what has been done, what differs between two of them.

Functions by the names of their commands; `capture4d.pipeline` hands them on.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from capture4d.captures.capture import Capture
from capture4d.captures.work_folder import AnyCapture, AnyWork, Place, opened_capture, opened_work, path_of
from capture4d.runs.changes import StageChanges
from capture4d.tracking.config import TrackingConfig
from registration.config import RegistrationConfig

if TYPE_CHECKING:
    from capture4d.app.differences.work_diff import WorkDiff
    from capture4d.app.status.plan import Plan
    from capture4d.app.status.survey import WorkStatus
    from capture4d.extraction.stage import ExtractionSettings

__all__ = ["changes", "diff", "made_anew", "needs_tracking", "plan", "plan_stage", "status"]


def changes(
    capture: AnyCapture,
    work: AnyWork,
    config: RegistrationConfig | None = None,
    *,
    tracking: TrackingConfig | None = None,
    tracked: bool = False,
) -> list[StageChanges]:
    """What the stages of `run` would do again, and why, in their order; nothing is done, nor written.

    Frames that a stage would do because of what comes out of a stage before it are among its `following`, at least.
    """
    from capture4d.extraction.stage import ExtractionSettings
    from capture4d.extraction.stage import changes as extraction
    from capture4d.tracking.stage import changes as track_changes
    from registration.stage import changes as registration

    opened, folder = opened_capture(capture), path_of(work)
    found = [extraction(opened, folder / "garment", ExtractionSettings())]
    tracked = tracked or needs_tracking(opened)
    if tracked:
        found.append(track_changes(opened, folder / "body", tracking or TrackingConfig()))
    last = registration(
        opened,
        folder / "garment",
        folder / "registration",
        config or RegistrationConfig(),
        body_folder=folder / "body" if tracked else None,
    )
    return [*found, last.after(found)]


def plan(
    capture: AnyCapture,
    work: AnyWork,
    config: RegistrationConfig | None = None,
    *,
    tracking: TrackingConfig | None = None,
    tracked: bool = False,
    renew: Collection[str] = (),
    workers: int = 1,
    overwrite: bool = False,
) -> Plan:
    """Tell what `run` would do with the same arguments, why, about how long it takes; nothing is done, nor written.

    Args:
        renew: what the whole take decides and is to be found anew, as for `renew`.
    """
    from capture4d.app.status.plan import plan_stages, renewed

    opened = opened_capture(capture)
    found = renewed(changes(opened, work, config, tracking=tracking, tracked=tracked), opened, path_of(work), renew)
    anew = made_anew(found) if overwrite else ()
    return plan_stages(opened, path_of(work), found, anew=anew, report=True, workers=workers)


def plan_stage(
    capture: AnyCapture,
    work: AnyWork,
    settings: ExtractionSettings | TrackingConfig | RegistrationConfig,
    *,
    tracked: bool = False,
    renew: Collection[str] = (),
    workers: int = 1,
    overwrite: bool = False,
) -> Plan:
    """The same of the one stage whose settings are given."""
    from capture4d.app.status.plan import plan_stages, renewed
    from capture4d.extraction.stage import ExtractionSettings
    from capture4d.extraction.stage import changes as extraction
    from capture4d.tracking.stage import changes as track_changes
    from registration.stage import changes as registration

    opened, folder = opened_capture(capture), path_of(work)
    match settings:
        case ExtractionSettings():
            found = extraction(opened, folder / "garment", settings)
        case TrackingConfig():
            found = track_changes(opened, folder / "body", settings)
        case RegistrationConfig():
            body = folder / "body" if tracked else None
            found = registration(opened, folder / "garment", folder / "registration", settings, body_folder=body)
    anew = (found.name,) if overwrite else ()
    return plan_stages(opened, folder, renewed([found], opened, folder, renew), anew=anew, workers=workers)


def status(work: AnyWork) -> WorkStatus:
    """Tell what is done in a work folder, what is running, stale or damaged, and why; which frames are flagged."""
    from capture4d.app.status.survey import survey

    return survey(path_of(work))


def diff(first: AnyWork, second: AnyWork, page: Place | None = None, *, overwrite: bool = False) -> WorkDiff:
    """Compare two work folders, finished or not: settings, metrics, and frames by their numbers.

    Args:
        first: what there was; `second`, what it has become.
        page: HTML file to write, with the curves of both.
        overwrite: write it over a file that is something else.
    """
    from capture4d.app.differences.page import write_page
    from capture4d.app.differences.work_diff import diff_works

    found = diff_works(opened_work(first), opened_work(second))
    if page is not None:
        write_page(found, Path(page), overwrite=overwrite)
    return found


def made_anew(found: Sequence[StageChanges]) -> tuple[str, ...]:
    """The stages that --overwrite is meant for: the first whose settings have changed and those after it, or all."""
    first = next((at for at, stage in enumerate(found) if stage.settings), 0)
    return tuple(stage.name for stage in found[first:])


def needs_tracking(capture: Capture) -> bool:
    """Whether the template is bound to a body of which the capture has no poses."""
    return capture.template.skin_weights is not None and not (capture.path / "poses.npz").is_file()
