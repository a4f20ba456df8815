"""`capture4d extract`, `track`, `register`, `run` and `report`: a capture's way to a registered garment."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

from capture4d.cli.options import StageOptions
from capture4d.tracking.config import TrackingConfig
from registration.config import RegistrationConfig

__all__ = ["Extract", "Register", "Report", "Run", "Track"]


@dataclass(frozen=True, kw_only=True)
class Extract(StageOptions):
    """Cut the garment out of every scan by its colour, and find its painted borders."""

    capture: Annotated[Positional[Path], arg(metavar="CAPTURE")]
    """Capture folder."""
    output: Path
    """Work folder; gets garment/."""
    learn_colours: bool = False
    """Learn the colours from the scans even where capture.json gives them; they then say which is which. Without
    garment_colour in capture.json they are learned anyway."""

    def __call__(self) -> int:
        from capture4d.extraction.stage import flagged_frames, run

        folder = self.output / "garment"
        run(self.capture, folder, learn_colours=self.learn_colours, workers=self.workers, overwrite=self.overwrite)
        flagged = flagged_frames(folder)
        if flagged:
            frame_id, reason = next(iter(flagged.items()))
            print(f"capture4d: no garment in {len(flagged)} frames, first in {frame_id}: {reason}", file=sys.stderr)
        print(f"garment: {folder}")
        return 0


@dataclass(frozen=True, kw_only=True)
class Track(StageOptions):
    """Track the body through every scan: its poses, and one shape for the take."""

    capture: Annotated[Positional[Path], arg(metavar="CAPTURE")]
    """Capture folder."""
    output: Path
    """Work folder; gets body/."""
    config: Annotated[TrackingConfig, arg(name="")] = field(default_factory=TrackingConfig)

    def __call__(self) -> int:
        from capture4d.tracking.stage import run

        run(self.capture, self.output / "body", self.config, workers=self.workers, overwrite=self.overwrite)
        print(f"body: {self.output / 'body'}")
        return 0


@dataclass(frozen=True, kw_only=True)
class Register(StageOptions):
    """Register the template to every frame whose garment `extract` has cut out."""

    capture: Annotated[Positional[Path], arg(metavar="CAPTURE")]
    """Capture folder."""
    output: Path
    """Work folder; holds garment/ and gets registration/."""
    tracked: bool = False
    """Move the template with the body that `track` found, not with the poses the capture brings."""
    preset: Literal["default", "paper"] = "default"
    """What the settings below start from; `paper` is DeepWrinkles as printed."""
    config: Annotated[RegistrationConfig, arg(name="")] = field(default_factory=RegistrationConfig)

    def __call__(self) -> int:
        from registration.stage import run

        run(
            self.capture,
            self.output / "garment",
            self.output / "registration",
            self.config,
            body_folder=self.output / "body" if self.tracked else None,
            workers=self.workers,
            overwrite=self.overwrite,
        )
        print(f"registration: {self.output / 'registration'}")
        return 0


@dataclass(frozen=True, kw_only=True)
class Run(StageOptions):
    """Run every stage on a capture: extract, track if it brings no poses, register, report."""

    capture: Annotated[Positional[Path], arg(metavar="CAPTURE")]
    """Capture folder."""
    output: Path
    """Work folder."""
    preset: Literal["default", "paper"] = "default"
    """What the settings of the registration start from; `paper` is DeepWrinkles as printed."""
    track: bool = False
    """Track the body even if the capture brings poses."""
    config: Annotated[RegistrationConfig, arg(name="registration")] = field(default_factory=RegistrationConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)

    def __call__(self) -> int:
        from capture4d.pipeline import run_all

        report = run_all(
            self.capture,
            self.output,
            self.config,
            tracking=self.tracking,
            track=self.track,
            workers=self.workers,
            overwrite=self.overwrite,
        )
        print(f"report: {report}")
        return 0


@dataclass(frozen=True, kw_only=True)
class Report(StageOptions):
    """Draw the report of a registered capture or an animated garment, and check its metrics against limits."""

    work: Annotated[Positional[Path], arg(metavar="WORK")]
    """Work folder; holds registration/ and gets report/."""
    fail_above: UseAppendAction[tuple[Annotated[str, arg(metavar="METRIC=LIMIT")], ...]] = ()
    """Exit with 1 if this metric of report/metrics.json is above the limit; may be given several times."""
    capture: Path | None = None
    """Capture folder, if it is not where it was when it was registered."""

    def __call__(self) -> int:
        from capture4d.pipeline import broken_limits, parse_limits, run_report

        limits = parse_limits(self.fail_above)
        page = run_report(self.work, capture=self.capture, workers=self.workers, overwrite=self.overwrite)
        print(f"report: {page}")
        broken = broken_limits(self.work, limits)
        for line in broken:
            print(f"capture4d: {line}", file=sys.stderr)
        return 1 if broken else 0
