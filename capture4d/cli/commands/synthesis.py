"""`capture4d demo`, `synth`, `scan`, `synth-board` and `synth-drapes`: captures and drapes that nobody filmed."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from capture4d.cli.exit_codes import BAD_RESULT, GOOD
from capture4d.cli.options import MeshOptions, StageOptions
from capture4d.cli.verdict import say_flagged
from capture4d.errors import InputError
from capture4d.settings import Percent
from data_synth import config as synth_config
from data_synth.drapes.config import DrapesConfig
from data_synth.scanner.config import ScanConfig
from data_synth.styles.config import STYLE_SETS

__all__ = ["Demo", "Scan", "Synth", "SynthBoard", "SynthDrapes"]


BOARD_POSES = 16
"""Of the board that the demo calibrates with."""
WRINKLE_STEPS = 500
"""Of the small network: it shows how wrinkles are learned; good ones take thousands of steps and frames."""
HELD_OUT = 0.15
"""Share of the demo's frames that the network does not see."""
OTHER_PERSON = (1.5, 2.0)
"""Whom the demo puts the garment on: taller and heavier than the captured subject."""


def _with_sensor(config: Any, sensor: Literal["depth", "stereo"] | None) -> Any:
    """Settings of a synthetic capture with another scanner, if one is given."""
    if sensor is None:
        return config
    return dataclasses.replace(config, scanner=dataclasses.replace(config.scanner, sensor=sensor))


@dataclass(frozen=True, kw_only=True)
class Synth(StageOptions):
    """Simulate a garment on a moving body and scan it: a capture folder with its exact truth."""

    output: Annotated[Positional[Path], arg(metavar="OUTPUT")]
    """Capture folder to write."""
    preset: Literal[*synth_config.PRESETS, *synth_config.TRAINING_SETS] = "demo"
    """What the settings below start from; a training set is many takes, and has no other settings."""
    scanner: Literal["depth", "stereo"] | None = None
    """Short for --scanner.sensor."""
    config: Annotated[synth_config.SynthConfig, arg(name="")] = field(default_factory=synth_config.SynthConfig)

    def __call__(self) -> int:
        from capture4d import pipeline

        chosen = synth_config.TRAINING_SETS.get(self.preset)
        if chosen is not None and (self.config != synth_config.SynthConfig() or self.scanner is not None):
            raise InputError(f"--preset {self.preset}: expected no other settings, for its takes bring their own")
        config = chosen or _with_sensor(self.config, self.scanner)
        result = pipeline.synth(self.output, config, workers=self.workers, overwrite=self.overwrite)
        print(f"capture: {result.path}" if chosen is None else f"captures: {result.path / 'takes'}")
        return GOOD


@dataclass(frozen=True, kw_only=True)
class Scan(StageOptions, MeshOptions):
    """Scan your own mesh sequence with the virtual camera rig: a capture folder, with truth if the faces stay."""

    meshes: Annotated[Positional[Path], arg(metavar="MESHES")]
    """Folder of mesh files, one per frame, named as the scans of a capture; or .npz with vertices (T, V, 3)
    and faces (F, 3)."""
    output: Annotated[Positional[Path], arg(metavar="OUTPUT")]
    """Capture folder to write."""
    template: Path | None = None
    """Mesh to register later: lies on the first mesh, or is the same mesh in another pose."""
    scanner: Literal["depth", "stereo"] | None = None
    """Short for --scanner.sensor."""
    config: Annotated[ScanConfig, arg(name="")] = field(default_factory=ScanConfig)

    def __call__(self) -> int:
        from capture4d import pipeline

        result = pipeline.scan(
            self.meshes,
            self.output,
            _with_sensor(self.config, self.scanner),
            template=self.template,
            workers=self.workers,
            overwrite=self.overwrite,
        )
        print(f"capture: {result.path}")
        return GOOD


@dataclass(frozen=True, kw_only=True)
class SynthBoard(StageOptions):
    """Photograph a calibration board with a virtual rig: images to try `calibrate` and `check-rig` on."""

    rig: Annotated[Positional[Path], arg(metavar="RIG")]
    """rig.json, such as that of a synthetic capture."""
    images: Annotated[Positional[Path], arg(metavar="IMAGES")]
    """Folder to write, IMAGES/CAMERA/POSE.png."""
    config: Annotated[synth_config.BoardConfig, arg(name="")] = field(default_factory=synth_config.BoardConfig)

    def __call__(self) -> int:
        from capture4d import pipeline

        pipeline.synth_board(self.rig, self.images, self.config, workers=self.workers, overwrite=self.overwrite)
        print(f"board images: {self.images}")
        return GOOD


@dataclass(frozen=True, kw_only=True)
class SynthDrapes(StageOptions):
    """Drape a garment cut from a sewing pattern over a still body in many poses: a set to learn from."""

    output: Annotated[Positional[Path], arg(metavar="OUTPUT")]
    """Folder to write."""
    max_pruned: Percent = 50.0
    """Percent of drapes that may be unfit to learn from; more of them end in exit code 3."""
    preset: Literal["one-style", *STYLE_SETS] = "one-style"
    """A set of one style on one person, as the settings below have it; or a style set, of many, which has no other
    settings."""
    config: Annotated[DrapesConfig, arg(name="")] = field(default_factory=DrapesConfig)

    def __call__(self) -> int:
        from capture4d import pipeline

        chosen = STYLE_SETS.get(self.preset)
        if chosen is not None and self.config != DrapesConfig():
            raise InputError(f"--preset {self.preset}: expected no other settings, for its pairs bring their own")
        result = pipeline.synth_drapes(
            self.output, chosen or self.config, workers=self.workers, overwrite=self.overwrite
        )
        kept = result.frames - len(result.failed)
        print(f"drapes: {result.path}, {kept} of {result.frames} fit to learn from")
        broken = result.failed_percent > self.max_pruned
        limit = f", more than the {self.max_pruned:g} % allowed" if broken else ""
        say_flagged(f"{len(result.failed)} drapes pruned ({result.failed_percent:.3g} %{limit})", result.failed)
        return BAD_RESULT if broken else GOOD


@dataclass(frozen=True, kw_only=True)
class Demo(StageOptions):
    """Make a synthetic capture, calibrate, track, register, learn the garment, put it on another body, export it: in
    minutes."""

    output: Path = Path("out")
    """Folder for everything, the capture included."""

    def __call__(self) -> int:
        report, other, exports = run_demo(self.output, workers=self.workers, overwrite=self.overwrite)
        print(f"report: {report}")
        print(f"on another body: {other}")
        print(f"for Blender: {exports / 'open_in_blender.py'}")
        print(f"in motion: {exports / 'garment.html'}")
        return GOOD


def run_demo(output: Path, *, workers: int, overwrite: bool = False) -> tuple[Path, Path, Path]:
    """Synthesise `output`/capture, calibrate its rig from photographs of a board, run everything on the scans, the true
    poses left aside, learn the garment and its wrinkles, compare what was learned, put the garment on another body
    and hand it on; the paths of the two reports, and the folder of the exports."""
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
    network = dataclasses.replace(
        network, held_out=HELD_OUT, schedule=dataclasses.replace(network.schedule, steps=WRINKLE_STEPS)
    )
    pipeline.wrinkles_train([output], model, network, **how)
    images = OffsetConfig(held_out=HELD_OUT, texels=128, training=OffsetTrainingConfig(epochs=60))
    pipeline.wrinkles_offsets(output, images, **how)
    pipeline.compare(output, model, CompareConfig(held_out=HELD_OUT), **how)
    report = pipeline.report(output, capture=capture, **how)
    poses, other = output / "body" / "poses.npz", Wearer(beta=OTHER_PERSON)
    pipeline.animate(output / "retarget", poses, output / "other", wearer=other, **how)
    pipeline.texture(output, **how)
    exports = hand_on(output / "other", model, output / "texture" / "albedo.png", **how)
    return report.path, pipeline.report(output / "other", **how).path, exports


def hand_on(work: Path, model: Path, albedo: Path, *, workers: int, overwrite: bool = False) -> Path:
    """Make the wrinkles of an animated garment and export it with them and its colours: as USD where that is
    installed, else as GLB, and as a page; the folder of the exports.

    Args:
        model: what `wrinkles train` wrote.
        albedo: what `texture` wrote.
    """
    from capture4d import pipeline
    from capture4d.app.export.config import ExportConfig, Format
    from capture4d.app.export.stage import default_format

    pipeline.wrinkles_apply(model, work, workers=workers, overwrite=overwrite)
    formats: list[Format] = [default_format(), "html"]
    done = pipeline.export(work, formats, config=ExportConfig(albedo=str(albedo)), overwrite=overwrite)
    return done.result.path
