"""Stages that go by frames, of takes that grow: what changes is redone, by what each frame was made from.

`runs.made` keeps what every file was made from; this is the folder around it. Other settings are refused, as by
`runs.stage`, for they are what a user decides; other inputs are not: what they change is said, and redone.

What the whole take decides (the subject's shape, learned colours) is a file of the stage as well, and what frames are
made from: it is kept while all that it was found from but the scans stays the same, so that a frame that is added does
not renew every other one; `--renew` finds it anew.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from capture4d.runs.changes import (
    StageChanges,
    description_changes,
    frame_changes,
    input_changes,
    say,
    setting_changes,
)
from capture4d.runs.frame_lists import counted, expanded, listed
from capture4d.runs.made import FileState, Ledger, Made, make
from capture4d.runs.stage import Stage, StageResult, earlier_record, opened_record, settings_of, unchanged_settings

__all__ = ["GrowingStage", "Pending", "Reads", "frames_of", "open_growing_stage", "stage_changes"]


@dataclass(frozen=True, slots=True)
class Reads:
    """What a stage reads, but for what each frame reads of its own."""

    description: Mapping[str, Any]
    """Of capture.json, by entry: it is said in words what changes there."""
    shared: Mapping[str, str]
    """Digests of what all frames share, by name."""
    frame_ids: tuple[int, ...]
    """Of the take, as it was asked for."""
    left_out: tuple[int, ...] = ()
    """Frames of the take that were not asked for; what is known of them is kept."""
    stages: Mapping[str, str] = field(default_factory=dict)
    """Digests of stages that it is made from; these have said themselves what changed."""


@dataclass(frozen=True, slots=True)
class Pending:
    """Frames that a stage is to do."""

    frames: tuple[int, ...]
    """For certain."""
    following: tuple[int, ...] = ()
    """If what they start from comes out otherwise than it was."""
    replaced: tuple[int, ...] = ()
    """Those of the former whose scans are others than before."""
    kept: tuple[str, ...] = ()
    """What was decided for the whole take and stays."""

    def keeping(self, *said: str) -> Pending:
        return replace(self, kept=said)


@dataclass(frozen=True, slots=True, eq=False)
class GrowingStage(Stage):
    """An open output folder. Made by `open_growing_stage`, closed by `finish`."""

    ledger: Ledger = field(kw_only=True)

    def stands(self, path: Path, inputs: Mapping[str, str]) -> bool:
        """Whether a file is there and was made from the same."""
        return self.ledger.stands(path, inputs)

    def make(
        self,
        path: Path,
        write: Callable[[], object],
        *,
        inputs: Mapping[str, str],
        files: Sequence[FileState] = (),
        said: Mapping[str, Any] | None = None,
    ) -> Made:
        """Write a file and note what it was made from; see `runs.made.make`."""
        made = make(self.path, path, write, inputs=inputs, files=files, said=said)
        self.ledger.note(path, made)
        return made

    def make_unless_standing(self, path: Path, write: Callable[[], object], *, inputs: Mapping[str, str]) -> Made:
        """The same, but only if it would be made from something else than it was."""
        known = self.ledger.of(path)
        return known if known is not None and self.stands(path, inputs) else self.make(path, write, inputs=inputs)

    def with_notes(self) -> GrowingStage:
        """The same, knowing what other processes have made since; they may make the same files again now."""
        return replace(self, ledger=Ledger.open(self.path))

    def digest_of_all(self, paths: Iterable[Path]) -> str:
        """Digest over the names and contents of files that were all made."""
        return self.ledger.digest_of(paths)

    def finish_growing(
        self, paths: Iterable[Path], *, frames: int, failed: Mapping[int, str] | None = None
    ) -> StageResult:
        """Mark the stage complete; its digest is over the names and contents of `paths`, which were all made."""
        self.ledger.settle()
        result = self.finish_with(self.digest_of_all(paths))
        return StageResult(result.path, result.digest, frames, failed or {})


def open_growing_stage(
    folder: Path,
    *,
    name: str,
    schema: int,
    config: Any,
    reads: Reads,
    sources: Mapping[str, Path],
    overwrite: bool = False,
) -> GrowingStage:
    """Create, resume or grow the folder of a stage that goes by frames; says what has changed since.

    Args:
        config: everything that decides the result but the inputs.
        sources: where the inputs lie, for later stages and for people.
        overwrite: start clean; deletes everything in the folder, if it is this stage's.
    Raises:
        InputError: the folder holds something else.
        StaleError: it holds this stage, made with other settings.
    """
    settings = settings_of(name, schema, config)
    existing = earlier_record(folder, name, overwrite=overwrite)
    if existing is not None:
        unchanged_settings(settings, existing, folder)
        changed = _changed_inputs(reads, existing)
        if changed:
            say(f"{folder.name}: {', '.join(changed)}")
    kept = {
        **settings,
        "upstream": {**reads.shared, **reads.stages},
        "description": dict(reads.description),
        "frames": listed(reads.frame_ids, most=0),
    }
    stage = opened_record(folder, kept, existing, sources, kind=partial(GrowingStage, ledger=Ledger.open(folder)))
    _drop_frames(stage, {*reads.frame_ids, *reads.left_out})
    return stage


def stage_changes(
    folder: Path,
    *,
    name: str,
    schema: int,
    config: Any,
    reads: Reads,
    pending: Callable[[Ledger], Pending],
) -> StageChanges:
    """A stage's folder against what it would be run with now; nothing is done, nor written.

    Args:
        pending: what there is to do, by what was made.
    Raises:
        InputError: the folder holds something else.
    """
    existing = earlier_record(folder, name, overwrite=False, discard=False)
    if existing is None:
        return StageChanges(name, folder, "absent", frames=len(reads.frame_ids), pending=reads.frame_ids)
    settings = settings_of(name, schema, config)
    changed = setting_changes(settings["config"], existing.get("config") or {})
    if existing.get("schema") != schema:
        changed.insert(0, f"format {existing.get('schema')} to {schema}")
    found = Pending(reads.frame_ids) if changed else pending(Ledger.read(folder))
    words = _changed_inputs(reads, existing)
    if found.replaced:
        words.append(counted(found.replaced, "replaced"))
    complete = existing.get("status") == "complete"
    current = complete and not (changed or words or found.frames)
    return StageChanges(
        name,
        folder,
        "current" if current else "outdated" if complete else "unfinished",
        tuple(changed),
        tuple(words),
        len(reads.frame_ids),
        found.frames,
        found.following,
        found.kept,
    )


def _changed_inputs(reads: Reads, record: Mapping[str, Any]) -> list[str]:
    """What has changed since a record of the stage was written, in words; but for scans and what frames read."""
    words = frame_changes(reads.frame_ids, frames_of(record) or reads.frame_ids)
    words += description_changes(reads.description, record.get("description", {}))
    shared = {name: digest for name, digest in record.get("upstream", {}).items() if name not in reads.stages}
    return words + input_changes(reads.shared, shared)


def frames_of(record: Mapping[str, Any]) -> tuple[int, ...] | None:
    """The frames that a stage's record says it was made for; None if it does not say."""
    text = record.get("frames")
    return expanded(text) if isinstance(text, str) else None


def _drop_frames(stage: GrowingStage, kept: set[int]) -> None:
    """Delete the files of frames that the take no longer has."""

    def stays(name: str) -> bool:
        number = name.partition(".")[0]
        return not number.isdecimal() or int(number) in kept

    for each in stage.path.iterdir():
        if each.is_dir() and not each.is_symlink():
            with os.scandir(each) as entries:
                gone = [entry.path for entry in entries if not stays(entry.name)]
            for path in gone:
                os.unlink(path)
    stage.ledger.forget(stays)
