"""What commands have in common. Standard library alone: `capture4d --help` loads it."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from capture4d.cli.exit_codes import BAD_RESULT, GOOD
from capture4d.cli.verdict import say_flagged
from capture4d.errors import CommandLineError
from capture4d.settings import Count, Percent

if TYPE_CHECKING:
    from pathlib import Path

    from capture4d.captures.capture import Capture
    from capture4d.runs.progress import Style
    from capture4d.runs.stage import StageResult

__all__ = [
    "ClusterOptions",
    "DecidingOptions",
    "GradedOptions",
    "MeshOptions",
    "ProgressOptions",
    "StageOptions",
    "TakeOptions",
    "all_cores",
]


def all_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(frozen=True, kw_only=True)
class MeshOptions:
    """Of commands that read meshes."""

    allow_outside: bool = False
    """Read textures and buffers that a mesh names outside its folder and its capture's, too: of meshes you trust.
    CAPTURE4D_ALLOW_OUTSIDE=1 in the environment does the same."""


@dataclass(frozen=True, kw_only=True)
class ProgressOptions:
    """Of commands that take long enough to say how far they are: a bar on a terminal, lines elsewhere."""

    quiet: bool = False
    """Say nothing of progress: only verdicts and faults."""
    json_progress: bool = False
    """Say it as JSON, one object a line on stderr, for machines."""

    @property
    def style(self) -> Style:
        """
        Raises:
            CommandLineError: it cannot be both.
        """
        if self.quiet and self.json_progress:
            raise CommandLineError("--json-progress: expected to be without --quiet, found both")
        return "quiet" if self.quiet else "json" if self.json_progress else "auto"


@dataclass(frozen=True, kw_only=True)
class ClusterOptions:
    """Of commands that can be done by several processes."""

    scheduler: str | None = None
    """Let the workers of a Dask scheduler do the work, in place of processes here: its address, such as
    tcp://HOST:8786. The result does not depend on it."""


@dataclass(frozen=True, kw_only=True)
class StageOptions(ProgressOptions, ClusterOptions):
    """Of stages: how they are run."""

    workers: Count = field(default_factory=all_cores)
    """Processes to use; the result does not depend on it."""
    overwrite: bool = False
    """Start clean: delete what an earlier run left in the output folder."""
    wait: bool = False
    """Wait for another command that is writing to the same folder, instead of refusing."""


@dataclass(frozen=True, kw_only=True)
class TakeOptions:
    """Of commands that read a take frame by frame."""

    frames: str | None = None
    """Only these frames of the take, such as 1,5,10-20 or, every fifth, 1-200:5; what is known of others is kept."""

    def taken(self, capture: Path) -> Capture | Path:
        """The capture in a folder, of the frames that are asked for."""
        if self.frames is None:
            return capture
        from capture4d.captures.capture import read_capture

        return read_capture(capture).choosing(self.frames)


@dataclass(frozen=True, kw_only=True)
class DecidingOptions(TakeOptions):
    """Of commands that decide something for the whole take."""

    renew: str = ""
    """Find anew what the whole take decides and is kept otherwise when frames come or go: shape, colours, or both with
    a comma between."""

    @property
    def to_renew(self) -> list[str]:
        return [name.strip() for name in self.renew.split(",") if name.strip()]

    def renewed(self, work: Path) -> None:
        """Let a work folder find anew what is to be."""
        from capture4d.runs.decisions import forget_decisions

        forget_decisions(work, self.to_renew)


@dataclass(frozen=True, kw_only=True)
class GradedOptions(StageOptions):
    """Of stages whose frames can fail."""

    max_failed: Percent = 5.0
    """Percent of frames that may fail; more of them end in exit code 3."""

    def graded(self, result: StageResult) -> int:
        """The exit code of a finished stage; says on stderr what is wrong with it."""
        if not result.failed:
            return GOOD
        count = f"{len(result.failed)} of {result.frames} frames failed ({result.failed_percent:.3g} %"
        broken = result.failed_percent > self.max_failed
        limit = f", more than the {self.max_failed:g} % allowed" if broken else ""
        say_flagged(f"{count}{limit})", result.failed)
        return BAD_RESULT if broken else GOOD
