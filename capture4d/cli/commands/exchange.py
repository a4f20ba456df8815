"""`capture4d export`: a garment out to other tools."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

from capture4d.app.export.config import FORMATS, ExportConfig, Format
from capture4d.cli.exit_codes import BAD_RESULT, GOOD
from capture4d.cli.options import ProgressOptions
from capture4d.errors import CommandLineError

__all__ = ["Export"]


@dataclass(frozen=True, kw_only=True)
class Export(ProgressOptions):
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
    overwrite: bool = False
    """Start clean: delete what an earlier run left in the output folder."""
    wait: bool = False
    """Wait for another command that is writing to the same folder, instead of refusing."""
    config: Annotated[ExportConfig, arg(name="")] = field(default_factory=ExportConfig)

    def __call__(self) -> int:
        from capture4d import pipeline
        from capture4d.app.export.stage import default_format, possible_formats

        if self.all and self.format:
            raise CommandLineError("--all: expected to be without --format, found both")
        formats = list(dict.fromkeys(self.format))
        if self.all:
            formats, left_out = possible_formats(FORMATS)
            for line in left_out:
                print(f"capture4d: {line}", file=sys.stderr)
        elif not formats:
            formats = [default_format()]
            if formats == ["glb"]:
                print("capture4d: writing GLB; pip install 'capture4d[usd]' makes USD the default", file=sys.stderr)
        done = pipeline.export(
            self.work, formats, self.output, self.config, frames=self.frames, overwrite=self.overwrite
        )
        for note in done.notes:
            print(f"capture4d: {self.work}: {note}", file=sys.stderr)
        for each in done.written:
            print(f"export: {each.file}: {done.result.frames} frames, {_error(each.error_mm, each.fit, each.targets)}")
        broken = [f"{each.file}: {'; '.join(each.faults)}" for each in done.written if each.faults]
        for line in broken:
            print(f"capture4d: {line}", file=sys.stderr)
        print(f"exports: {done.result.path}")
        return BAD_RESULT if broken else GOOD


def _error(largest: float, fit: object, targets: int | None) -> str:
    if fit is None:
        return f"read back within {largest:.4f} mm"
    mean, p99 = getattr(fit, "mean_mm", 0.0), getattr(fit, "p99_mm", 0.0)
    return f"{targets} shapes, error {mean:.3f} mm in the mean, {p99:.3f} at 99 %, {largest:.3f} at most"
