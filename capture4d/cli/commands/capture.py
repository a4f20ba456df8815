"""`capture4d check`, `calibrate` and `check-rig`: the rig and the take, before a stage is run."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

from capture4d.calibration.config import CalibrationConfig, RigCheckConfig
from capture4d.cli.exit_codes import BAD_RESULT, GOOD
from capture4d.cli.options import ClusterOptions, MeshOptions, ProgressOptions, all_cores
from capture4d.errors import InputError
from capture4d.settings import Count, Positive

__all__ = ["Calibrate", "Check", "CheckRig"]


@dataclass(frozen=True, kw_only=True)
class Check(ProgressOptions, ClusterOptions, MeshOptions):
    """Look through a take before a night is spent on it; exit code 3 if it has errors."""

    capture: Annotated[Positional[Path], arg(metavar="CAPTURE")]
    """Capture folder, or just a folder of scans."""
    pattern: str | None = None
    """How scans are named, such as "take_{frame}.ply"; else the last number in a name that differs is the frame's."""
    fps: Positive | None = None
    """Frame rate, if capture.json does not say, or is to be doubted."""
    units: Literal["m", "cm", "mm", "in"] | None = None
    """What the scans are said to be in, likewise."""
    garment_colour: str | None = None
    """Such as #2f62c9, likewise."""
    border_colour: UseAppendAction[tuple[str, ...]] = ()
    """A paint on the borders, likewise; may be given several times."""
    rig: Path | None = None
    """rig.json, if it is not in the folder."""
    poses: Path | None = None
    """poses.npz, likewise."""
    body: Path | None = None
    """body.npz, likewise."""
    all: bool = False
    """Look at every frame instead of a sample."""
    fix: bool = False
    """Write a corrected take to CAPTURE-fixed; looks at every frame. Scans that are sound as they are become hard links
    to the originals."""
    output: Path | None = None
    """Folder for the corrected take, with --fix, instead of CAPTURE-fixed."""
    strict: bool = False
    """Exit code 3 for warnings, too."""
    json: bool = False
    """Print JSON instead of a table."""
    page: Path | None = None
    """An HTML page to write as well."""
    workers: Count = field(default_factory=all_cores)
    """Processes to use; the result does not depend on it."""

    def __call__(self) -> int:
        import json

        from capture4d import pipeline
        from capture4d.app.report.check import as_json, print_table, status, write_page
        from capture4d.preflight.repair.fix import fixed_path
        from capture4d.preflight.take_folder import Claims

        claims = Claims(
            self.pattern,
            self.fps,
            self.units,
            self.garment_colour,
            self.border_colour,
            self.rig,
            self.poses,
            self.body,
        )
        if self.output is not None and not self.fix:
            raise InputError("--output: expected --fix with it, for only a corrected take is written")
        output = (self.output or fixed_path(self.capture)) if self.fix else None
        checked = pipeline.check(self.capture, output, claims, all_frames=self.all, workers=self.workers)
        if self.json:
            print(json.dumps(as_json(checked), indent=2))
        else:
            print_table(checked)
            if checked.fixed is not None:
                print(f"corrected: {checked.fixed} ({checked.how_fixed})")
            elif self.fix:
                print("nothing to correct, nothing written")
        if self.page is not None:
            write_page(self.page, checked)
        bad = ("warnings", "errors") if self.strict else ("errors",)
        return BAD_RESULT if status(checked.verdict) in bad else GOOD


@dataclass(frozen=True, kw_only=True)
class Calibrate(ProgressOptions, ClusterOptions):
    """Calibrate a camera rig from images of a ChArUco board or a checkerboard, with a report of how good it is."""

    images: Annotated[Positional[Path], arg(metavar="IMAGES")]
    """Folder of board images: png, jpg, tif, bmp, webp, pgm or ppm, one a camera and pose of the board."""
    board: str
    """charuco:COLUMNSxROWS:SQUARE_MM:MARKER_MM:DICTIONARY, such as charuco:14x10:60:44:DICT_5X5_100, or
    checkerboard:COLUMNSxROWS:SQUARE_MM; both count squares."""
    output: Path
    """rig.json to write; calibration.json and calibration.html go beside it."""
    pattern: str = "{camera}/{pose}"
    """How the images lie in the folder, without their ending."""
    workers: Count = field(default_factory=all_cores)
    """Processes to use; the result does not depend on it."""
    colmap: Path | None = None
    """Folder for the rig as a COLMAP model as well."""
    overwrite: bool = False
    """Calibrate anew, also over a rig of other settings; corners that are known stay known."""
    config: Annotated[CalibrationConfig, arg(name="")] = field(default_factory=CalibrationConfig)

    def __call__(self) -> int:
        from capture4d import pipeline
        from capture4d.app.report.calibration import print_calibration

        result = pipeline.calibrate(
            self.images,
            self.output,
            self.board,
            self.config,
            pattern=self.pattern,
            colmap=self.colmap,
            workers=self.workers,
            overwrite=self.overwrite,
        )
        print_calibration(result.report)
        print(f"rig: {result.path}, report: {self.output.with_name('calibration.html')}")
        return GOOD


@dataclass(frozen=True, kw_only=True)
class CheckRig(ProgressOptions, ClusterOptions):
    """Tell which cameras have moved since calibration, from one pose of the board; exit code 3 if one has."""

    rig: Annotated[Positional[Path], arg(metavar="RIG")]
    """rig.json; the calibration.json beside it knows the board and how certain the rig is."""
    images: Annotated[Positional[Path], arg(metavar="IMAGES")]
    """Folder of board images, as for `calibrate`; one pose will do."""
    board: str | None = None
    """The board, if it is not the one of the calibration."""
    pattern: str = "{camera}/{pose}"
    """How the images lie in the folder, without their ending."""
    workers: Count = field(default_factory=all_cores)
    """Processes to use; the result does not depend on it."""
    config: Annotated[RigCheckConfig, arg(name="")] = field(default_factory=RigCheckConfig)

    def __call__(self) -> int:
        from capture4d import pipeline
        from capture4d.app.report.calibration import print_check

        checks = pipeline.check_rig(
            self.rig, self.images, self.config, board=self.board, pattern=self.pattern, workers=self.workers
        )
        print_check(checks)
        moved = [check.name for check in checks if check.verdict == "moved"]
        if moved:
            print(f"capture4d: moved since calibration: {', '.join(moved)}", file=sys.stderr)
        return BAD_RESULT if moved else GOOD
