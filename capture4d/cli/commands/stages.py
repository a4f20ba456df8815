"""`capture4d extract`, `track`, `register`, `run` and `report`: a capture's way to a registered garment."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

from capture4d.cli.dry_run import DryRunOptions
from capture4d.cli.exit_codes import BAD_RESULT, GOOD
from capture4d.cli.options import DecidingOptions, GradedOptions, MeshOptions, StageOptions, TakeOptions
from capture4d.cli.verdict import say_flagged, say_verdict, say_work
from capture4d.tracking.config import TrackingConfig
from registration.config import RegistrationConfig

if TYPE_CHECKING:
    from capture4d.captures.work_folder import AnyCapture

__all__ = ["Extract", "Register", "Report", "Run", "Track"]


@dataclass(frozen=True, kw_only=True)
class Extract(DryRunOptions, DecidingOptions, StageOptions, MeshOptions):
    """Cut the garment out of every scan by its colour, and find its painted borders."""

    capture: Annotated[Positional[Path], arg(metavar="CAPTURE")]
    """Capture folder."""
    output: Path
    """Work folder; gets garment/."""
    learn_colours: bool = False
    """Learn the colours from the scans even where capture.json gives them; they then say which is which. Without
    garment_colour in capture.json they are learned anyway."""

    def __call__(self) -> int:
        from capture4d import pipeline
        from capture4d.app.status.work_folders import plan_stage
        from capture4d.extraction.stage import ExtractionSettings

        taken = self.taken(self.capture)
        if self.dry_run:
            return self.told(plan_stage(
                taken, self.output, ExtractionSettings(learn_colours=self.learn_colours),
                renew=self.to_renew, workers=self.workers, overwrite=self.overwrite,
            ))  # fmt: skip
        self.renewed(self.output)
        result = pipeline.extract(
            taken,
            self.output,
            learn_colours=self.learn_colours,
            workers=self.workers,
            overwrite=self.overwrite,
        )
        found = result.frames - len(result.failed)
        say_flagged(f"no garment in {len(result.failed)} of {result.frames} frames", result.failed)
        _say_clouds(self.output)
        print(f"extract: {found} of {result.frames} frames with a garment")
        print(f"garment: {result.path}")
        return GOOD


@dataclass(frozen=True, kw_only=True)
class Track(DryRunOptions, DecidingOptions, StageOptions, MeshOptions):
    """Track the body through every scan: its poses, and one shape for the take."""

    capture: Annotated[Positional[Path], arg(metavar="CAPTURE")]
    """Capture folder."""
    output: Path
    """Work folder; gets body/."""
    config: Annotated[TrackingConfig, arg(name="tracking")] = field(default_factory=TrackingConfig)

    def __call__(self) -> int:
        from capture4d import pipeline
        from capture4d.app.status.work_folders import plan_stage

        taken = self.taken(self.capture)
        if self.dry_run:
            return self.told(plan_stage(
                taken, self.output, self.config,
                renew=self.to_renew, workers=self.workers, overwrite=self.overwrite,
            ))  # fmt: skip
        self.renewed(self.output)
        result = pipeline.track(taken, self.output, self.config, workers=self.workers, overwrite=self.overwrite)
        say_flagged(f"lost in {len(result.failed)} of {result.frames} frames", result.failed)
        say_verdict(result.path, "track")
        print(f"body: {result.path}")
        return GOOD


@dataclass(frozen=True, kw_only=True)
class Register(DryRunOptions, TakeOptions, GradedOptions, MeshOptions):
    """Register the template to every frame whose garment `extract` has cut out."""

    capture: Annotated[Positional[Path], arg(metavar="CAPTURE")]
    """Capture folder."""
    output: Path
    """Work folder; holds garment/ and gets registration/."""
    tracked: bool = False
    """Move the template with the body that `track` found, not with the poses the capture brings."""
    preset: Literal["default", "paper"] = "default"
    """What the settings below start from; `paper` is DeepWrinkles as printed."""
    print: Path | None = None
    """Picture of what is printed on the cloth, over the template's UVs; short for --registration.colour.print."""
    config: Annotated[RegistrationConfig, arg(name="registration")] = field(default_factory=RegistrationConfig)

    def __call__(self) -> int:
        from capture4d import pipeline
        from capture4d.app.status.work_folders import plan_stage

        taken, config = self.taken(self.capture), _with_print(self.config, self.print)
        if self.dry_run:
            return self.told(plan_stage(
                taken, self.output, config,
                tracked=self.tracked, workers=self.workers, overwrite=self.overwrite,
            ))  # fmt: skip
        _say_lengths(taken)
        result = pipeline.register(
            taken,
            self.output,
            config,
            tracked=self.tracked,
            workers=self.workers,
            overwrite=self.overwrite,
        )
        say_verdict(result.path, "register")
        print(f"registration: {result.path}")
        return self.graded(result)


@dataclass(frozen=True, kw_only=True)
class Run(DryRunOptions, DecidingOptions, GradedOptions, MeshOptions):
    """Run every stage on a capture: extract, track if it brings no poses, register, report."""

    capture: Annotated[Positional[Path], arg(metavar="CAPTURE")]
    """Capture folder."""
    output: Path
    """Work folder."""
    preset: Literal["default", "paper"] = "default"
    """What the settings of the registration start from; `paper` is DeepWrinkles as printed."""
    print: Path | None = None
    """Picture of what is printed on the cloth, over the template's UVs; short for --registration.colour.print."""
    tracked: bool = False
    """Track the body, and move the template with it, even if the capture brings poses."""
    config: Annotated[RegistrationConfig, arg(name="registration")] = field(default_factory=RegistrationConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)

    def __call__(self) -> int:
        from capture4d import pipeline

        taken, config = self.taken(self.capture), _with_print(self.config, self.print)
        if self.dry_run:
            return self.told(pipeline.plan(
                taken, self.output, config, tracking=self.tracking, tracked=self.tracked,
                renew=self.to_renew, workers=self.workers, overwrite=self.overwrite,
            ))  # fmt: skip
        self.renewed(self.output)
        _say_lengths(taken)
        result = pipeline.run(
            taken,
            self.output,
            config,
            tracking=self.tracking,
            tracked=self.tracked,
            workers=self.workers,
            overwrite=self.overwrite,
        )
        _say_clouds(self.output)
        say_work(self.output)
        print(f"report: {result.path}")
        return self.graded(result)


def _with_print(config: RegistrationConfig, picture: Path | None) -> RegistrationConfig:
    """Settings of the registration with another print, if one is given."""
    if picture is None:
        return config
    return replace(config, colour=replace(config.colour, print=str(picture)))


def _say_lengths(capture: AnyCapture) -> None:
    """Tell where the lengths of the cloth come from, before a night is spent on it."""
    from capture4d.captures.work_folder import opened_capture
    from capture4d.preflight.readiness import pattern_told

    print(pattern_told(opened_capture(capture)))


def _say_clouds(work: Path) -> None:
    """Tell of scans that are points alone, as extraction has noted."""
    from capture4d.extraction.stage import CLOUDS
    from capture4d.files.atomic import read_json

    path = work / "garment" / CLOUDS
    if path.is_file():
        count = len(read_json(path)["frames"])
        print(f"capture4d: {count} scans are points without faces; normals and faces are estimated", file=sys.stderr)


@dataclass(frozen=True, kw_only=True)
class Report(StageOptions, MeshOptions):
    """Draw the report of a registered capture or an animated garment, and check its metrics against limits."""

    work: Annotated[Positional[Path], arg(metavar="WORK")]
    """Work folder; holds registration/ and gets report/."""
    fail_above: UseAppendAction[tuple[Annotated[str, arg(metavar="METRIC=LIMIT")], ...]] = ()
    """Exit with 3 if this metric of report/metrics.json is above the limit; may be given several times."""
    fail_below: UseAppendAction[tuple[Annotated[str, arg(metavar="METRIC=LIMIT")], ...]] = ()
    """Exit with 3 if it is below, likewise: for metrics of which more is better, such as frames_good_percent."""
    capture: Path | None = None
    """Capture folder, if it is not where it was when it was registered."""

    def __call__(self) -> int:
        from capture4d import pipeline
        from capture4d.app.report.limits import broken_limits, parse_limits

        limits = parse_limits(self.fail_above, self.fail_below)
        result = pipeline.report(self.work, capture=self.capture, workers=self.workers, overwrite=self.overwrite)
        print(f"report: {result.path}")
        broken = broken_limits(self.work, limits)
        for line in broken:
            print(f"capture4d: {line}", file=sys.stderr)
        return BAD_RESULT if broken else GOOD
