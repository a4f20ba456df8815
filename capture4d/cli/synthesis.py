"""`capture4d synth`, `scan` and `synth-board`: captures that nobody filmed."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from capture4d.cli.exit_codes import GOOD
from capture4d.cli.options import StageOptions
from capture4d.errors import InputError
from data_synth import config as synth_config
from data_synth.scanner.config import ScanConfig

__all__ = ["Scan", "Synth", "SynthBoard"]


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
class Scan(StageOptions):
    """Scan your own mesh sequence with the virtual camera rig: a capture folder, with truth if the faces stay."""

    meshes: Annotated[Positional[Path], arg(metavar="MESHES")]
    """Folder of mesh files, one per frame, in order of the last number in their names; or .npz with vertices (T, V, 3)
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
