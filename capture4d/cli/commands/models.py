"""`capture4d fit`, `animate` and `fit-styles`: the garment as a model."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from capture4d.cli.exit_codes import GOOD
from capture4d.cli.options import GradedOptions, MeshOptions, StageOptions
from capture4d.cli.verdict import say_verdict
from capture4d.errors import CommandLineError, InputError
from capture4d.settings import Number
from retarget.config import AnimateConfig, FitConfig
from retarget.mixture import config as mixture_config

__all__ = ["Animate", "Fit", "FitStyles"]


@dataclass(frozen=True, kw_only=True)
class Fit(StageOptions, MeshOptions):
    """Learn the garment from registered takes: its blendshapes, and the regressors that drive them with poses."""

    works: Annotated[Positional[tuple[Path, ...]], arg(metavar="WORK")]
    """Work folders of registered takes of one template and one person."""
    output: Path | None = None
    """Work folder that gets retarget/; the take's own if there is one take."""
    device: str = "cpu"
    """Where torch trains, such as cpu or cuda."""
    config: Annotated[FitConfig, arg(name="")] = field(default_factory=FitConfig)

    def __call__(self) -> int:
        from capture4d import pipeline

        if not self.works:
            raise CommandLineError("WORK: expected at least one work folder, found none")
        first, *others = self.works
        if self.output is None and others:
            raise CommandLineError(
                f"--output: expected a work folder for what {1 + len(others)} takes give, found none"
            )
        folder = (self.output or first) / "retarget"
        result = pipeline.fit(
            self.works, folder, self.config, device=self.device, workers=self.workers, overwrite=self.overwrite
        )
        print(f"model: {result.path}")
        return GOOD


@dataclass(frozen=True, kw_only=True)
class Animate(GradedOptions):
    """Put a learned garment on a motion, and on another body: a sequence like a registered one."""

    model: Annotated[Positional[Path], arg(metavar="MODEL")]
    """What `fit` wrote: WORK, WORK/retarget, or the blendshapes.safetensors in it; or the folder that `fit-styles`
    wrote."""
    poses: Path
    """Motion file, .npz or .bvh."""
    output: Path
    """Work folder; gets body/ and registration/."""
    body: Path | None = None
    """Another person, a body.npz of the same faces and joints."""
    beta: tuple[Number, ...] | None = None
    """Shape of the person, in standard deviations; the captured person without --body and --beta."""
    styles: Annotated[tuple[str, ...], arg(name="style")] = ()
    """Numbers of the pattern, NAME=VALUE each, for a garment with styles; in the middle of their range without."""
    device: str = "cpu"
    """Where torch computes, such as cpu or cuda."""
    config: Annotated[AnimateConfig, arg(name="")] = field(default_factory=AnimateConfig)

    def __call__(self) -> int:
        from capture4d import pipeline
        from capture4d.captures.work_folder import load_records
        from retarget.animation.stage import Wearer

        result = pipeline.animate(
            self.model,
            self.poses,
            self.output,
            self.config,
            wearer=Wearer(self.body, self.beta, _numbers(self.styles) if self.styles else None),
            device=self.device,
            workers=self.workers,
            overwrite=self.overwrite,
        )
        say_verdict(result.path, "animate")
        print(f"registration: {result.path}")
        doubtful = [record for record in load_records(result.path) if record["verdict"] == "check"]
        if doubtful:
            first = f"frame {doubtful[0]['frame_id']}: {'; '.join(doubtful[0]['reasons'])}"
            print(f"capture4d: {len(doubtful)} of {result.frames} frames are to be checked; {first}", file=sys.stderr)
        return self.graded(result)


def _numbers(texts: tuple[str, ...]) -> dict[str, float]:
    """NAME=VALUE texts as numbers by name."""
    found = {}
    for text in texts:
        name, sign, value = text.partition("=")
        try:
            found[name] = float(value)
        except ValueError:
            sign = ""
        if not sign or not math.isfinite(found[name]):
            raise InputError(f"--style: expected NAME=VALUE, a number, found {text!r}")
    return found


@dataclass(frozen=True, kw_only=True)
class FitStyles(StageOptions):
    """Learn a garment in all its styles, on everybody and in every pose, from a style set of drapes."""

    styles: Annotated[Positional[Path], arg(metavar="STYLES")]
    """What `synth-drapes --preset` wrote."""
    output: Path
    """Folder of the model."""
    preset: Literal[*mixture_config.PRESETS] = "default"
    """What the settings below start from; `paper` is TailorNet's recipe, 330 million parameters at its size."""
    config: Annotated[mixture_config.StylesConfig, arg(name="")] = field(default_factory=mixture_config.StylesConfig)

    def __call__(self) -> int:
        from capture4d import pipeline
        from capture4d.files.atomic import read_json

        result = pipeline.fit_styles(
            self.styles, self.output, self.config, workers=self.workers, overwrite=self.overwrite
        )
        for part, errors in read_json(result.path / "errors.json")["errors"].items():
            print(f"{part}: {errors['vertex_mm']:.1f} mm, {errors['normal_deg']:.1f} deg, {errors['drapes']} drapes")
        print(f"model: {result.path}")
        return GOOD
