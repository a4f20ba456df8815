"""`capture4d offsets train` and `offsets predict`: a garment learned from static drapes, as offsets from the body."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from capture4d.cli.exit_codes import GOOD
from capture4d.cli.options import GradedOptions, StageOptions, all_cores
from capture4d.cli.verdict import say_verdict
from capture4d.settings import Count
from wrinkles.offset_images import config as offset_config
from wrinkles.offset_images.config import DrapeOffsetsConfig, PredictOffsetsConfig

__all__ = ["OffsetsPredict", "OffsetsTrain"]


@dataclass(frozen=True, kw_only=True)
class OffsetsTrain(StageOptions):
    """Learn a garment from static drapes, as offset images or otherwise; says how far off it is on drapes that it has
    not seen."""

    drapes: Annotated[Positional[Path], arg(metavar="DRAPES")]
    """What `synth-drapes` wrote."""
    output: Path
    """Folder of the model."""
    preset: Literal[*offset_config.PRESETS] = "default"
    """What the settings below start from; `paper` and what begins so are the networks and losses of Jin et al."""
    labels: Path | None = None
    """A .npy with a whole number for each face of the garment, its patch; without, patches of like size."""
    config: Annotated[DrapeOffsetsConfig, arg(name="")] = field(
        default_factory=lambda: offset_config.PRESETS["default"]
    )
    workers: Count = field(default_factory=all_cores)
    """Threads for the training; equal numbers give equal weights."""

    def __call__(self) -> int:
        from capture4d import pipeline
        from capture4d.files.atomic import read_json

        result = pipeline.offsets_train(
            self.drapes, self.output, self.config, labels=self.labels, workers=self.workers, overwrite=self.overwrite
        )
        errors = read_json(result.path / "errors.json")
        for part in ("train", "validation", "test"):
            found = errors[part]
            print(f"{part}: {found['vertex_cm']:.2f} cm, mean offsets {found['mean_vertex_cm']:.2f} cm, "
                  f"{found['drapes']} drapes")  # fmt: skip
        print(f"model: {result.path}")
        return GOOD


@dataclass(frozen=True, kw_only=True)
class OffsetsPredict(GradedOptions):
    """Put a garment that `offsets train` learned on a motion of the person it was draped on, taken out of the body."""

    model: Annotated[Positional[Path], arg(metavar="MODEL")]
    """What `offsets train` wrote."""
    poses: Path
    """Motion to follow, one of those that `convert-poses` reads."""
    output: Path
    """Work folder; gets body/ and registration/, as `animate` writes them."""
    config: Annotated[PredictOffsetsConfig, arg(name="")] = field(default_factory=PredictOffsetsConfig)

    def __call__(self) -> int:
        from capture4d import pipeline

        result = pipeline.offsets_predict(
            self.model, self.poses, self.output, self.config, workers=self.workers, overwrite=self.overwrite
        )
        say_verdict(result.path, "predict")
        print(f"registration: {result.path}")
        return self.graded(result)
