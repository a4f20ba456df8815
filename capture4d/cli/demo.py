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
    from data_synth.config import PRESETS, BoardConfig
    from retarget.animation.stage import Wearer
    from retarget.config import FitConfig, TrainingConfig
    from wrinkles.normal_maps.config import PRESETS as WRINKLES
    from wrinkles.offset_images.config import OffsetConfig, OffsetTrainingConfig

    capture, board, model = output / "capture", BoardConfig(poses=BOARD_POSES), output / "wrinkles" / "model"
    how = {"workers": workers, "overwrite": overwrite}
    pipeline.synth(capture, PRESETS["demo"], **how)
    pipeline.synth_board(capture / "rig.json", output / "rig" / "board", board, **how)
    pipeline.calibrate(output / "rig" / "board", output / "rig" / "rig.json", board.board, **how)
    pipeline.run(capture, output, tracked=True, draw=False, **how)
    pipeline.fit([output], output / "retarget", FitConfig(training=TrainingConfig(epochs=60, patience=20)), **how)
    network = WRINKLES["small"]
    network = replace(network, held_out=HELD_OUT, schedule=replace(network.schedule, steps=WRINKLE_STEPS))
    pipeline.wrinkles_train([output], model, network, **how)
    images = OffsetConfig(held_out=HELD_OUT, texels=128, training=OffsetTrainingConfig(epochs=60))
    pipeline.wrinkles_offsets(output, images, **how)
    pipeline.compare(output, model, CompareConfig(held_out=HELD_OUT), **how)
    report = pipeline.report(output, capture=capture, **how)
    poses, other = output / "body" / "poses.npz", Wearer(beta=OTHER_PERSON)
    pipeline.animate(output / "retarget", poses, output / "other", wearer=other, **how)
    return report.path, pipeline.report(output / "other", **how).path
