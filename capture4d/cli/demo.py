"""`capture4d demo`: the whole way on a synthetic take, from photographs of a board to the garment on another body."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from capture4d.cli.exit_codes import GOOD
from capture4d.cli.options import StageOptions

__all__ = ["Demo"]

BOARD_POSES = 16
"""Of the board that the demo calibrates with."""
WRINKLE_STEPS = 500
"""Of the small network: it shows how wrinkles are learned; good ones take thousands of steps and frames."""
HELD_OUT = 0.15
"""Share of the demo's frames that the network does not see."""
OTHER_PERSON = (1.5, 2.0)
"""Whom the demo puts the garment on: taller and heavier than the captured subject."""


@dataclass(frozen=True, kw_only=True)
class Demo(StageOptions):
    """Make a synthetic capture, calibrate, track, register, learn the garment, put it on another body: in minutes."""

    output: Path = Path("out")
    """Folder for everything, the capture included."""

    def __call__(self) -> int:
        report, other = run_demo(self.output, workers=self.workers, overwrite=self.overwrite)
        print(f"report: {report}")
        print(f"on another body: {other}")
        return GOOD


def run_demo(output: Path, *, workers: int, overwrite: bool = False) -> tuple[Path, Path]:
    """Synthesise `output`/capture, calibrate its rig from photographs of a board, run everything on the scans, the true
    poses left aside, learn the garment and its wrinkles, compare what was learned, and put the garment on another body;
    the paths of the two reports."""
    from capture4d import pipeline
    from capture4d.app.compare.config import CompareConfig
    from capture4d.app.compare.page import run as compare
    from capture4d.captures.work_folder import open_work
    from data_synth.config import PRESETS
    from data_synth.stage import run as synthesise
    from retarget.animation.stage import Wearer
    from retarget.animation.stage import run as animate
    from retarget.config import AnimateConfig, FitConfig, TrainingConfig
    from retarget.fit_stage import run as fit
    from wrinkles.normal_maps.config import PRESETS as WRINKLES
    from wrinkles.normal_maps.train_stage import run as train_wrinkles
    from wrinkles.offset_images.config import OffsetConfig, OffsetTrainingConfig
    from wrinkles.offset_images.stage import run as learn_offsets

    synthesise(output / "capture", PRESETS["demo"], workers=workers, overwrite=overwrite)
    _calibrate_demo(output / "capture" / "rig.json", output / "rig", workers=workers, overwrite=overwrite)
    pipeline.run(output / "capture", output, tracked=True, draw=False, workers=workers, overwrite=overwrite)
    quick = TrainingConfig(epochs=60, patience=20)
    fit([open_work(output)], output / "retarget", FitConfig(training=quick), workers=workers, overwrite=overwrite)
    network = WRINKLES["small"]
    network = replace(network, held_out=HELD_OUT, schedule=replace(network.schedule, steps=WRINKLE_STEPS))
    train_wrinkles([open_work(output)], output / "wrinkles" / "model", network, workers=workers, overwrite=overwrite)
    images = OffsetConfig(held_out=HELD_OUT, texels=128, training=OffsetTrainingConfig(epochs=60))
    learn_offsets(open_work(output), output / "wrinkles" / "offsets", images, workers=workers, overwrite=overwrite)
    shown = CompareConfig(held_out=HELD_OUT)
    compare(open_work(output), output / "wrinkles" / "model", shown, workers=workers, overwrite=overwrite)
    report = pipeline.report(output, capture=output / "capture", workers=workers, overwrite=overwrite)
    animate(
        output / "retarget",
        output / "body" / "poses.npz",
        output / "other",
        AnimateConfig(),
        wearer=Wearer(beta=OTHER_PERSON),
        workers=workers,
        overwrite=overwrite,
    )
    return report.path, pipeline.report(output / "other", workers=workers, overwrite=overwrite).path


def _calibrate_demo(truth: Path, folder: Path, *, workers: int, overwrite: bool) -> None:
    """Photograph a board with the true rig, and calibrate from the photographs alone."""
    from capture4d.app.report.calibration import write_page
    from capture4d.calibration.stage import run as calibrate
    from data_synth.board.stage import run as photograph
    from data_synth.config import BoardConfig

    config = BoardConfig(poses=BOARD_POSES)
    photograph(truth, folder / "board", config, workers=workers, overwrite=overwrite)
    rig = folder / "rig.json"
    calibrated = calibrate(folder / "board", rig, config.board, workers=workers, overwrite=overwrite)
    write_page(folder / "calibration.html", calibrated.report)
