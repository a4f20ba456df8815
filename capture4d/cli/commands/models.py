"""`capture4d fit`, `animate`, `fit-styles` and `fit-style`: the garment as a model."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from capture4d.cli.commands.files import FileOptions
from capture4d.cli.exit_codes import BAD_RESULT, GOOD
from capture4d.cli.options import GradedOptions, MeshOptions, StageOptions
from capture4d.cli.verdict import say_verdict
from capture4d.errors import CommandLineError, InputError
from capture4d.settings import Number
from retarget.config import AnimateConfig, FitConfig
from retarget.mixture import config as mixture_config

__all__ = ["Animate", "Fit", "FitStyle", "FitStyles"]


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
    """Style of a garment with styles: NAME=VALUE each; or numbers in their order, such as 0.5,-1; or @style.json, which
    `fit-style` wrote. What is left out is in the middle of its range."""
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
            wearer=Wearer(self.body, self.beta, _style(self.styles)),
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


def _style(texts: tuple[str, ...]) -> dict[str, float] | tuple[float, ...] | None:
    """A style as it was given: numbers by name, numbers in their order, or what a style.json says; None without."""
    if not texts:
        return None
    first, *others = texts
    if first.startswith("@"):
        if others:
            raise InputError(f"--style: expected one file, or numbers, found {others[0]!r} after {first!r}")
        return _style_of_file(Path(first[1:]))
    if not any("=" in text for text in texts):
        return tuple(_finite(part, texts) for text in texts for part in text.split(","))
    found = {}
    for text in texts:
        name, sign, value = text.partition("=")
        if not sign:
            raise InputError(f"--style: expected NAME=VALUE, found {text!r}")
        found[name] = _finite(value, texts)
    return found


def _finite(text: str, texts: tuple[str, ...]) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"--style: expected NAME=VALUE, numbers or @FILE, found {' '.join(texts)!r}")
    return value


def _style_of_file(path: Path) -> dict[str, float]:
    from capture4d.files.atomic import read_json
    from capture4d.files.json_values import entry, number
    from capture4d.files.reading import reading

    about = read_json(path)
    with reading(path, "style"):
        style = entry(about, "style")
        if not isinstance(style, dict):
            raise InputError("style: expected an object of numbers by name, found something else")
        return {name: number(value, f"style.{name}") for name, value in style.items()}


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


@dataclass(frozen=True, kw_only=True)
class FitStyle(FileOptions):
    """Find the style and the person of a registered or scanned garment, with a garment with styles as model."""

    model: Annotated[Positional[Path], arg(metavar="MODEL")]
    """The folder that `fit-styles` wrote."""
    work: Annotated[Positional[Path], arg(metavar="WORK")]
    """Work folder of a take that was registered, or extracted and tracked, on the model's body."""
    output: Path
    """style.json to write, which `animate` takes for a style."""
    config: Annotated[mixture_config.StyleFitConfig, arg(name="")] = field(
        default_factory=mixture_config.StyleFitConfig
    )

    def __call__(self) -> int:
        from capture4d import pipeline

        found = pipeline.fit_style(self.model, self.work, self.output, self.config, overwrite=self.overwrite)
        fit = found.fit
        print(f"style: {', '.join(f'{name} {value:.3f}' for name, value in fit.style.items())}")
        print(f"beta: {' '.join(f'{value:.2f}' for value in fit.beta)}")
        print(f"residual: {fit.residual_mm.mean():.1f} mm in {len(found.frame_ids)} frames: {found.path}")
        for reason in found.reasons:
            print(f"capture4d: to be checked: {reason}", file=sys.stderr)
        return BAD_RESULT if found.reasons else GOOD
