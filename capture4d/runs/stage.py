"""Stages that survive a crash: folders that resume, and refuse to go on with other settings.

A stage is a folder with a `stage.json` and one file per frame. A file either exists whole or does not exist, so the
work that is left after a crash is the files that are missing, and the same command finishes it with the same result.
A stage remembers its settings and the digests of what it was made from, and refuses to continue with others.
"""

from __future__ import annotations

import json
import os
import shutil
import zipfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from capture4d.errors import InputError, StaleError
from capture4d.files.atomic import TEMPORARY_SUFFIX, file_digest, plain_value, read_json, write_json
from capture4d.files.json_values import entry, text, whole
from capture4d.files.reading import reading
from capture4d.runs.changes import input_changes, setting_changes
from capture4d.runs.decisions import DECISIONS
from capture4d.runs.frame_lists import frame_file
from capture4d.runs.locks import LOCK

__all__ = [
    "SCHEMAS",
    "Stage",
    "StageResult",
    "complete_record",
    "earlier_record",
    "open_stage",
    "opened_record",
    "read_record",
    "require_complete",
    "result_of",
    "settings_of",
    "unchanged_settings",
]

Opened = TypeVar("Opened", bound="Stage")

FORMER_NAMES = {"wrinkles maps": "pairs", "wrinkles train": "train-wrinkles", "wrinkles apply": "wrinkles"}
"""Names that stages have had: a folder that bears one is read, and continued, as the stage's own."""
FORMER_STAGES = {former: name for name, former in FORMER_NAMES.items()}


SCHEMAS = {
    "animate": 2, "calibrate": 1, "compare": 6, "export": 1, "export-onnx": 1, "extract": 6, "fit": 7, "fit-styles": 1,
    "import": 1, "offsets train": 3, "register": 6, "report": 4, "scan": 2, "synth": 3,
    "synth-board": 1, "synth-drapes": 4, "synth-styles": 3, "texture": 1, "track": 7, "training-set": 1,
    "wrinkles apply": 2, "wrinkles maps": 1, "wrinkles offsets": 3, "wrinkles train": 1,
}  # fmt: skip
"""Formats of the stages' outputs: a folder with a higher number comes from a later version."""


@dataclass(frozen=True, slots=True)
class StageResult:
    """What every stage returns: where its output lies, and how many of its frames failed."""

    path: Path
    """What a user opens or hands on: the stage's folder, or the one file that it is about."""
    digest: str
    """Of the output; equal for equal results."""
    frames: int = 0
    """Of the take; 0 where the stage does not go by frames."""
    failed: Mapping[int, str] = field(default_factory=dict)
    """Frames without a usable result, and why."""

    @property
    def failed_percent(self) -> float:
        return 100 * len(self.failed) / max(self.frames, 1)


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """An open output folder. Made by `open_stage`, closed by `finish`."""

    path: Path
    _record: dict[str, Any]
    _earlier: dict[str, Any] | None = None
    """Record of the run before, if that was complete."""

    @property
    def was_complete(self) -> bool:
        """An earlier run with these settings and inputs has finished."""
        return self._earlier is not None

    def frame_path(self, frame_id: int, suffix: str = ".npz", *, folder: str = "frames") -> Path:
        """Where a frame's file goes: `<stage>/<folder>/000123<suffix>`."""
        return frame_file(self.path, frame_id, suffix, folder)

    def pending(self, frame_ids: Iterable[int], suffix: str = ".npz", *, folder: str = "frames") -> list[int]:
        """The frames that have no valid file yet, in the order given."""
        return [frame_id for frame_id in frame_ids if not _is_whole(self.frame_path(frame_id, suffix, folder=folder))]

    def count(self, suffix: str = ".npz", *, folder: str = "frames") -> int:
        """How many frames have a file, whole or not: cheap enough to be asked every second."""
        try:
            with os.scandir(self.path / folder) as entries:
                return sum(entry.name.endswith(suffix) and not entry.name.startswith(".") for entry in entries)
        except FileNotFoundError:
            return 0

    def finish(
        self,
        paths: Iterable[Path],
        *,
        changed: bool = True,
        output: Path | None = None,
        frames: int = 0,
        failed: Mapping[int, str] | None = None,
    ) -> StageResult:
        """Mark the stage complete. Its digest is over the names and contents of `paths`.

        Leave out of `paths` what differs between equal runs, such as times.

        Args:
            changed: False if nothing was written since the stage was opened: if it was complete then, its digest is
                not computed again.
            output: what a user opens; the folder if None.
            frames: of the take, and `failed`, those of them without a usable result, with the reason.
        """
        paths = list(paths)
        result = partial(StageResult, output or self.path, frames=frames, failed=failed or {})
        if self._earlier is not None and not changed and all(path.is_file() for path in paths):
            write_json(self.path / "stage.json", {**self._earlier, "sources": self._record["sources"]})
            return result(digest=self._earlier["digest"])
        return result(digest=self.finish_with(file_digest(paths, root=self.path)).digest)

    def finish_with(self, digest: str) -> StageResult:
        """Mark the stage complete, of a digest that is known."""
        earlier = self._earlier or {}
        same = earlier.get("digest") == digest
        if not same:
            for leftover in self.path.rglob(f".*{TEMPORARY_SUFFIX}"):
                leftover.unlink(missing_ok=True)
        finished = earlier.get("finished", _now()) if same else _now()
        record = {**self._record, "status": "complete", "digest": digest, "finished": finished}
        write_json(self.path / "stage.json", record)
        return StageResult(self.path, digest)


def open_stage(
    folder: str | Path,
    *,
    name: str,
    schema: int,
    config: Any,
    upstream: Mapping[str, str],
    sources: Mapping[str, Path] | None = None,
    overwrite: bool = False,
) -> Stage:
    """Open an output folder, new or to be continued.

    Args:
        name: of the stage, as in "registration".
        schema: number of the output's format; a change makes old output unusable.
        config: frozen dataclass of everything that decides the result (so not the number of workers).
        upstream: digest of each input, by name.
        sources: where the inputs lie, for later stages and for people. Inputs may be moved, so this decides nothing.
        overwrite: start clean; deletes everything in the folder, if it is this stage's.
    Raises:
        InputError: the folder holds something else.
        StaleError: it holds this stage, made with other settings or from other inputs.
    """
    folder = Path(folder)
    settings = {**settings_of(name, schema, config), "upstream": dict(upstream)}
    existing = earlier_record(folder, name, overwrite=overwrite)
    if existing is not None:
        unchanged_settings(settings, existing, folder)
        changed = input_changes(settings["upstream"], existing.get("upstream", {}))
        if changed:
            raise StaleError(
                f"was made from other inputs ({', '.join(changed[:3])}); with --overwrite the same command makes it "
                "from those that are there now",
                where=folder,
            )
    return opened_record(folder, settings, existing, sources or {})


# --- the record of a folder --------------------------------------------------------------------------------------


def settings_of(name: str, schema: int, config: Any) -> dict[str, Any]:
    """What a record says of a stage's settings."""
    assert schema <= SCHEMAS.get(name, schema), f"SCHEMAS says less of {name}"
    return {"stage": name, "schema": schema, "config": json.loads(json.dumps(config, default=plain_value))}


def earlier_record(folder: Path, name: str, *, overwrite: bool, discard: bool = True) -> dict[str, Any] | None:
    """The record of a stage's earlier run in a folder; None if there was none, or it is to be deleted and now is.

    Args:
        overwrite: delete it, with all that it tells of.
        discard: False deletes nothing, not even what was about to be.
    Raises:
        InputError: the folder holds something else.
    """
    record_path = folder / "stage.json"
    if folder.exists() and not folder.is_dir():
        raise InputError("expected a folder to write to, found a file", where=folder)
    existing = read_record(record_path) if record_path.exists() else None
    if existing is not None and existing.get("stage") == FORMER_NAMES.get(name):
        existing = {**existing, "stage": name}
    if existing is None and folder.is_dir() and not _is_blank(folder):
        raise InputError(f"expected an empty folder or an earlier run of '{name}', found other files", where=folder)
    if existing is not None and existing.get("stage") != name:
        raise InputError(f"expected output of '{name}', found output of '{existing.get('stage')}'", where=folder)
    if existing is not None and (overwrite or existing.get("status") == "discarded"):
        if discard:
            _discard(folder, existing)
        return None
    return existing


def unchanged_settings(settings: Mapping[str, Any], existing: Mapping[str, Any], folder: Path) -> None:
    """Raises StaleError where a stage's folder was made with other settings, or in another format."""
    if existing.get("schema") != settings["schema"]:
        raise StaleError(
            f"was made by an earlier version of capture4d, in format {existing.get('schema')}; with --overwrite the "
            "same command makes it anew",
            where=folder,
        )
    changed = setting_changes(settings["config"], existing.get("config") or {})
    if changed:
        more = f" and {len(changed) - 3} more" if len(changed) > 3 else ""
        raise StaleError(
            f"was made with other settings ({', '.join(changed[:3])}{more}); with --overwrite the same command makes "
            "it anew, and keeps what it is made from",
            where=folder,
        )


def opened_record(
    folder: Path,
    settings: Mapping[str, Any],
    existing: Mapping[str, Any] | None,
    sources: Mapping[str, Path],
    *,
    kind: Callable[[Path, dict[str, Any], dict[str, Any] | None], Opened] = Stage,
) -> Opened:
    """Write down what a folder is about to be made with, unless that is known.

    Args:
        kind: of stage to open: made of the folder, its record, and that of the run before if it is complete.
    """
    started = _now() if existing is None else existing.get("started", _now())
    places = {name: str(path.resolve()) for name, path in sources.items()}
    record = {**settings, "sources": places, "status": "running", "started": started}
    same = existing is not None and all(existing.get(key) == value for key, value in settings.items())
    if existing is None or existing.get("status") != "running" or not same:
        write_json(folder / "stage.json", record)
    complete = existing is not None and same and existing.get("status") == "complete"
    return kind(folder, record, dict(existing) if existing is not None and complete else None)


def result_of(folder: Path, output: Path | None = None) -> StageResult:
    """What the run that finished a stage returned, as far as its record knows."""
    return StageResult(output or folder, read_record(folder / "stage.json")["digest"])


def require_complete(
    folder: str | Path,
    name: str,
    command: str,
    *,
    made_from: Mapping[str, str] | None = None,
) -> str:
    """The digest of a finished stage; `complete_record` has the arguments."""
    return complete_record(folder, name, command, made_from=made_from)["digest"]


def complete_record(
    folder: str | Path,
    name: str,
    command: str,
    *,
    made_from: Mapping[str, str] | None = None,
) -> Mapping[str, Any]:
    """The stage.json of a finished stage: its `digest`, the `config` and the `upstream` it was made with.

    Args:
        made_from: digests of inputs that it has to have been made from, by name.
    Raises:
        InputError: it is missing or unfinished; the message names `command`, which repairs that.
        StaleError: it was made from something else.
    """
    folder = Path(folder)
    if not (folder / "stage.json").is_file():
        raise InputError(f"expected the output of '{name}', found none; run: {command}", where=folder)
    record = read_record(folder / "stage.json")
    if record.get("stage") not in (name, FORMER_NAMES.get(name)):
        raise InputError(f"expected the output of '{name}', found output of '{record.get('stage')}'", where=folder)
    if record.get("status") != "complete":
        raise InputError(f"'{name}' is not finished; run: {command}", where=folder)
    for key, digest in (made_from or {}).items():
        if record.get("upstream", {}).get(key) != digest:
            raise StaleError(
                f"expected the output of '{name}' from this {key} as it is now, found that of another or of an earlier "
                f"state; run: {command} --overwrite",
                where=folder,
            )
    return record


def read_record(path: Path) -> dict[str, Any]:
    """What a stage.json, or the record of a stage without a folder, says.

    Raises:
        InputError: it is damaged, of no stage, or of a later version.
    """
    record = read_json(path)
    with reading(path, "record of a stage"):
        name, schema = text(entry(record, "stage"), "stage"), whole(entry(record, "schema"), "schema")
        if not name.isprintable():
            raise InputError(f"stage: expected a name, found {name[:40]!r}")
        newest = SCHEMAS.get(FORMER_STAGES.get(name, name), schema)
        if schema > newest:
            raise InputError(
                f"expected format {newest} of '{name}' or an earlier one, found {schema}: it comes from a later "
                "version of capture4d"
            )
        if record.get("status") == "complete":
            text(entry(record, "digest"), "digest")
        for key in ("upstream", "sources"):
            if not isinstance(record.get(key, {}), dict):
                raise InputError(f"{key}: expected an object, found {type(record[key]).__name__}")
        for key in ("upstream", "sources"):
            for each, value in record.get(key, {}).items():
                text(value, f"{key}.{each[:40]}")
    return record


def _is_blank(folder: Path) -> bool:
    """Nothing in it but folders, the temporary files of a run that was killed before its first file, and decisions that
    were taken over from another take."""
    ours = {LOCK, *(Path(place).name for places in DECISIONS.values() for place in places)}
    return not any(
        path.is_file() and path.suffix != TEMPORARY_SUFFIX and path.name not in ours for path in folder.rglob("*")
    )


def _discard(folder: Path, record: dict[str, Any]) -> None:
    """Empty a stage folder; if that is interrupted, the record left behind says to go on."""
    write_json(folder / "stage.json", {**record, "status": "discarded"})
    for path in folder.iterdir():
        if path.name in ("stage.json", LOCK):
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


def _is_whole(path: Path) -> bool:
    """Atomic writes make existing files whole; this also catches what a lost disk or a careless copy cut off."""
    try:
        return zipfile.is_zipfile(path) if path.suffix == ".npz" else path.stat().st_size > 0
    except OSError:
        return False


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
