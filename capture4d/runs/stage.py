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
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from capture4d.errors import InputError, StaleError
from capture4d.files.atomic import TEMPORARY_SUFFIX, file_digest, plain_value, read_json, write_json
from capture4d.files.json_values import entry, text, whole
from capture4d.files.reading import reading
from capture4d.runs.locks import LOCK

__all__ = [
    "SCHEMAS",
    "Stage",
    "StageResult",
    "complete_record",
    "differences",
    "open_stage",
    "read_record",
    "require_complete",
    "result_of",
]

FORMER_NAMES = {"wrinkles maps": "pairs", "wrinkles train": "train-wrinkles", "wrinkles apply": "wrinkles"}
"""Names that stages have had: a folder that bears one is read, and continued, as the stage's own."""
FORMER_STAGES = {former: name for name, former in FORMER_NAMES.items()}


SCHEMAS = {
    "animate": 1, "calibrate": 1, "compare": 5, "extract": 4, "fit": 5, "register": 4, "report": 4, "scan": 2,
    "synth": 2, "synth-board": 1, "track": 4, "training-set": 1, "wrinkles apply": 2, "wrinkles maps": 1,
    "wrinkles offsets": 1, "wrinkles train": 1,
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
        return self.path / folder / f"{frame_id:06d}{suffix}"

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
        for leftover in self.path.rglob(f".*{TEMPORARY_SUFFIX}"):
            leftover.unlink(missing_ok=True)
        digest = file_digest(paths, root=self.path)
        finished = {**self._record, "status": "complete", "digest": digest, "finished": _now()}
        write_json(self.path / "stage.json", finished)
        return result(digest=digest)


def open_stage(
    folder: str | Path,
    *,
    name: str,
    schema: int,
    config: Any,
    upstream: Mapping[str, str],
    sources: Mapping[str, Path] | None = None,
    formerly: Mapping[str, str] | None = None,
    overwrite: bool = False,
) -> Stage:
    """Open an output folder, new or to be continued.

    Args:
        name: of the stage, as in "registration".
        schema: number of the output's format; a change makes old output unusable.
        config: frozen dataclass of everything that decides the result (so not the number of workers).
        upstream: digest of each input, by name.
        sources: where the inputs lie, for later stages and for people. Inputs may be moved, so this decides nothing.
        formerly: an earlier `upstream` whose results still hold; a folder that was made from it is taken over.
        overwrite: start clean; deletes everything in the folder, if it is this stage's.
    Raises:
        InputError: the folder holds something else.
        StaleError: it holds this stage, made with other settings or from other inputs.
    """
    assert schema <= SCHEMAS.get(name, schema), f"SCHEMAS says less of {name}"
    folder = Path(folder)
    record_path = folder / "stage.json"
    settings = {
        "stage": name,
        "schema": schema,
        "config": json.loads(json.dumps(config, default=plain_value)),
        "upstream": dict(upstream),
    }
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
        _discard(folder, existing)
        existing = None
    if existing is not None and formerly not in (None, upstream) and existing.get("upstream") == formerly:
        existing = {**existing, "upstream": settings["upstream"], "status": "taken over"}
    if existing is not None:
        changed = list(differences(settings, existing))
        if changed:
            raise StaleError(f"was made with other settings ({'; '.join(changed[:3])}); use --overwrite", where=folder)
        started = existing.get("started", _now())
    else:
        started = _now()
    places = {name: str(path.resolve()) for name, path in (sources or {}).items()}
    record = {**settings, "sources": places, "status": "running", "started": started}
    if existing is None or existing.get("status") != "running":
        write_json(record_path, record)
    return Stage(folder, record, existing if existing and existing.get("status") == "complete" else None)


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


def differences(now: Any, before: Any, prefix: str = "") -> Iterator[str]:
    """What settings say now, and said before, one text for each that changed."""
    for key in now:
        label = f"{prefix}{key}"
        new, old = now[key], before.get(key) if isinstance(before, dict) else None
        if isinstance(new, dict) and isinstance(old, dict):
            yield from differences({**dict.fromkeys(old), **new}, old, f"{label}.")
        elif new != old:
            yield f"{label}: was {_short(old)}, now {_short(new)}"


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 40 else f"{text[:36]}..."


def _is_blank(folder: Path) -> bool:
    """Nothing in it but folders and the temporary files of a run that was killed before its first file."""
    return not any(
        path.is_file() and path.suffix != TEMPORARY_SUFFIX and path.name != LOCK for path in folder.rglob("*")
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
