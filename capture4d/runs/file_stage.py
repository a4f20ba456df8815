"""Stages whose output is a few files among others of the user's: a record beside them says what they were made with.

Stages that have a folder to themselves are those of `capture4d.runs.stage`; a record holds the same in both.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from capture4d.files.atomic import file_digest, write_json
from capture4d.runs.stage import read_record, settings_of, unchanged_settings

__all__ = ["FileStage", "open_file_stage"]


@dataclass(frozen=True, slots=True, eq=False)
class FileStage:
    """Made by `open_file_stage`, closed by `finish`. Until then the record is that of the run before."""

    record_path: Path
    _record: dict[str, Any]
    _earlier: dict[str, Any] | None
    """Record of a run before with the same settings, from the same inputs."""
    _left: Mapping[str, str]
    """Digest of each file that a run before has left, by its name, whatever that was made with."""

    def made(self, files: Sequence[Path]) -> str | None:
        """Their digest, if a run before has made these files from the same and they are still as it left them."""
        if self._earlier is None or not all(path.is_file() for path in files):
            return None
        digest = self._earlier["digest"]
        return digest if file_digest(files, root=self.record_path.parent) == digest else None

    def may_replace(self, files: Sequence[Path]) -> bool:
        """Whether what is there of these files is as a run before has left it: then none of them is the user's."""
        there = [path for path in files if path.exists()]
        return all(path.is_file() and self._left.get(path.name) == _digest(path) for path in there)

    def finish(self, files: Sequence[Path]) -> str:
        """Record that these files, in the record's folder, are made; their digest."""
        digest = file_digest(files, root=self.record_path.parent)
        finished = {**self._record, "status": "complete", "digest": digest, "finished": _now()}
        write_json(self.record_path, {**finished, "files": {path.name: _digest(path) for path in files}})
        return digest


def open_file_stage(
    record_path: Path,
    *,
    name: str,
    schema: int,
    config: Any,
    upstream: Mapping[str, str],
    sources: Mapping[str, Path],
    overwrite: bool = False,
) -> FileStage:
    """Begin to make files, or find them made.

    Args:
        name: of the stage, as in "calibrate".
        schema: number of the output's format.
        config: everything that decides the result but the inputs.
        upstream: digest of each input, by name. Files that were made from others are made anew without a question.
        sources: where the inputs lie, for people.
        overwrite: make the files anew, whatever they were made with.
    Raises:
        InputError: the record cannot be read.
        StaleError: the files were made with other settings.
    """
    settings = settings_of(name, schema, config)
    earlier = read_record(record_path) if record_path.is_file() else None
    left = {} if earlier is None else earlier.get("files", {})
    if earlier is not None and not overwrite:
        unchanged_settings(settings, earlier, record_path)
    if earlier is not None and (overwrite or earlier.get("upstream") != dict(upstream)):
        earlier = None
    places = {key: str(path.resolve()) for key, path in sources.items()}
    record = {**settings, "upstream": dict(upstream), "sources": places, "started": _now()}
    return FileStage(record_path, record, earlier, left)


def _digest(path: Path) -> str:
    return file_digest([path], root=path.parent)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
