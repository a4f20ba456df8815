"""`capture4d texture`, `export`, `export-onnx`, `import` and `score`: a garment out to other tools, and back."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

from tyro.conf import Positional, UseAppendAction, arg

from capture4d.app.export.config import FORMATS, Along, ExportConfig, Format
from capture4d.app.importing.config import ImportConfig
from capture4d.app.onnx_models.config import OnnxConfig
from capture4d.cli.exit_codes import BAD_RESULT, GOOD
from capture4d.cli.options import MeshOptions, ProgressOptions, StageOptions
from capture4d.errors import CommandLineError
from capture4d.texturing.config import TextureConfig

if TYPE_CHECKING:
    from capture4d.app.export.correctives import FitError

__all__ = ["Export", "ExportOnnx", "Import", "Score", "Texture"]


@dataclass(frozen=True, kw_only=True)
class Texture(StageOptions):
    """Bake the colours of a take's scans to the template's UVs: one picture, without the light that fell on them."""

    work: Annotated[Positional[Path], arg(metavar="WORK")]
    """Work folder of a registered take; gets texture/."""
    config: Annotated[TextureConfig, arg(name="")] = field(default_factory=TextureConfig)

    def __call__(self) -> int:
        from capture4d import pipeline
        from capture4d.files.atomic import read_json

        result = pipeline.texture(self.work, self.config, workers=self.workers, overwrite=self.overwrite)
        told = read_json(result.path / "texture.json")
        dark, bright = told["light"]
        print(
            f"texture: {result.frames} frames, {100 * told['seen_share']:.1f} % of it seen, frames differ by "
            f"{told['spread_levels']:.1f} levels, light from {dark:.2f} to {bright:.2f}"
        )
        print(f"albedo: {result.path / 'albedo.png'}")
        return GOOD


@dataclass(frozen=True, kw_only=True)
class _Alone(ProgressOptions):
    """Of commands that work in one process, and write a folder of their own."""

    overwrite: bool = False
    """Start clean: delete what an earlier run left in the output folder."""
    wait: bool = False
    """Wait for another command that is writing to the same folder, instead of refusing."""


@dataclass(frozen=True, kw_only=True)
class Export(_Alone):
    """Hand a registered or animated garment on to other tools: USD, Alembic, GLB, point caches, a mesh a frame."""

    work: Annotated[Positional[Path], arg(metavar="WORK")]
    """Work folder of a take or an animation."""
    format: UseAppendAction[tuple[Format, ...]] = ()
    """What to write; may be given several times. USD if its package is installed, else GLB, if absent."""
    all: bool = False
    """Write every format whose package is installed."""
    output: Path | None = None
    """Folder to write; WORK/exports if absent."""
    frames: str = ""
    """Only these frames of the take, such as 1,5,10-20 or, every fifth, 1-200:5."""
    with_: Annotated[str, arg(name="with", metavar="PARTS")] = ""
    """What goes along: scans, body, or scans,body; short for --along scans body."""
    config: Annotated[ExportConfig, arg(name="")] = field(default_factory=ExportConfig)

    def __call__(self) -> int:
        from capture4d import pipeline
        from capture4d.app.export.stage import SCRIPT, default_format, possible_formats

        if self.all and self.format:
            raise CommandLineError("--all: expected to be without --format, found both")
        formats: list[Format] = [*dict.fromkeys(self.format)]
        if self.all:
            formats, left_out = possible_formats(FORMATS)
            for line in left_out:
                print(f"capture4d: {line}", file=sys.stderr)
        elif not formats:
            formats = [default_format()]
        config = replace(self.config, along=(*dict.fromkeys((*self.config.along, *_parts(self.with_))),))
        done = pipeline.export(self.work, formats, self.output, config, frames=self.frames, overwrite=self.overwrite)
        for note in done.notes:
            print(f"capture4d: {self.work}: {note}", file=sys.stderr)
        if not self.all and not self.format and formats == ["glb"]:
            print("capture4d: wrote GLB; pip install 'capture4d[usd]' makes USD the default", file=sys.stderr)
        for each in done.written:
            print(f"export: {each.file}: {done.result.frames} frames, {_error(each.error_mm, each.fit, each.targets)}")
        broken = [f"{each.file}: {'; '.join(each.faults)}" for each in done.written if each.faults]
        for line in broken:
            print(f"capture4d: {line}", file=sys.stderr)
        print(f"exports: {done.result.path}")
        if (script := done.result.path / SCRIPT).is_file():
            print(f"for Blender: blender -P {script}")
        return BAD_RESULT if broken else GOOD


def _parts(said: str) -> list[Along]:
    known: dict[str, Along] = {each: each for each in get_args(Along)}
    words = [*filter(None, (part.strip() for part in said.split(",")))]
    unknown = [word for word in words if word not in known]
    if unknown:
        raise CommandLineError(f"--with: expected scans, body or both, found '{unknown[0]}'")
    return [known[word] for word in words]


@dataclass(frozen=True, kw_only=True)
class ExportOnnx(_Alone):
    """Write a learned garment or a wrinkle network as an ONNX file, which runs without capture4d, and compare both."""

    model: Annotated[Positional[Path], arg(metavar="MODEL")]
    """Folder of `fit`, `fit-styles` or `wrinkles train`."""
    output: Path | None = None
    """Folder to write; MODEL/onnx if absent."""
    config: Annotated[OnnxConfig, arg(name="")] = field(default_factory=OnnxConfig)

    def __call__(self) -> int:
        from capture4d import pipeline

        result, found = pipeline.export_onnx(self.model, self.output, self.config, overwrite=self.overwrite)
        print(
            f"export-onnx: {found.kind}, differs by {found.mean:.2g} {found.unit} in the mean, {found.largest:.2g} at "
            f"most; {found.onnx_ms:.2f} ms, in {found.ours_by} {found.ours_ms:.2f}"
        )
        print(f"onnx: {result.path}")
        for line in found.faults:
            print(f"capture4d: {line}", file=sys.stderr)
        return BAD_RESULT if found.faults else GOOD


def _error(largest: float, fit: FitError | None, targets: int | None) -> str:
    if fit is None:
        return f"read back within {largest:.4f} mm"
    return f"{targets} shapes, error {fit.mean_mm:.3f} mm in the mean, {fit.p99_mm:.3f} at 99 %, {largest:.3f} at most"


@dataclass(frozen=True, kw_only=True)
class Import(_Alone, MeshOptions):
    """Bring in a sequence that another tool registered or edited: USD, Alembic, a point cache, a mesh file a frame."""

    meshes: Annotated[Positional[Path], arg(metavar="MESHES")]
    """Folder with a mesh file a frame, its number in its name; or a .usd, .usda, .usdc, .abc, .glb, .pc2 or .mdd
    file."""
    template: Path
    """The mesh that moves, in the same order of vertices: template.npz or garment.npz, or a mesh file."""
    output: Path
    """Work folder; gets registration/."""
    config: Annotated[ImportConfig, arg(name="")] = field(default_factory=ImportConfig)

    def __call__(self) -> int:
        from capture4d import pipeline

        result = pipeline.import_meshes(self.meshes, self.template, self.output, self.config, overwrite=self.overwrite)
        print(f"import: {result.frames} frames")
        print(f"registration: {result.path}")
        return GOOD


@dataclass(frozen=True, kw_only=True)
class Score(StageOptions):
    """Measure a registered sequence, whoever made it, against the truth of a synthetic take, as its report would."""

    work: Annotated[Positional[Path], arg(metavar="WORK")]
    """Work folder, such as `import` writes; gets score.json."""
    capture: Annotated[Positional[Path], arg(metavar="CAPTURE")]
    """Capture folder with its truth, of the same template."""
    fail_above: UseAppendAction[tuple[Annotated[str, arg(metavar="METRIC=LIMIT")], ...]] = ()
    """Exit with 3 if this metric is above the limit; may be given several times."""

    def __call__(self) -> int:
        from capture4d import pipeline
        from capture4d.app.report.limits import broken_among, parse_limits
        from capture4d.app.report.metrics import METRICS, shown

        limits = parse_limits(self.fail_above)
        found = pipeline.score(self.work, self.capture, workers=self.workers)
        if found.without_scan:
            said = f"the scans of {found.without_scan} frames cannot be read; every vertex counts as seen there"
            print(f"capture4d: {self.capture}: {said}", file=sys.stderr)
        for key, value in found.metrics.items():
            print(f"{key:32s} {shown(value):>8s} {METRICS[key][0]}".rstrip())
        print(f"score: {found.frames} frames: {found.path}")
        broken = broken_among(found.metrics, limits, where=found.path)
        for line in broken:
            print(f"capture4d: {line}", file=sys.stderr)
        return BAD_RESULT if broken else GOOD
