"""What has changed since the stages of a work folder were run, with the settings that they were run with."""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from capture4d.app.report.take import SCHEMA as REPORT_SCHEMA
from capture4d.app.report.take import shown_from
from capture4d.captures.capture import Capture
from capture4d.captures.work_folder import REGISTER
from capture4d.errors import InputError
from capture4d.extraction.stage import ExtractionSettings
from capture4d.extraction.stage import changes as extraction_changes
from capture4d.runs.changes import StageChanges, input_changes
from capture4d.tracking.config import TrackingConfig
from capture4d.tracking.stage import changes as tracking_changes
from registration.config import RegistrationConfig
from registration.stage import changes as registration_changes

__all__ = ["linked", "made_from", "rebuilt", "report_changes", "take_changes"]

Settings = TypeVar("Settings")

MADE_FROM = {
    "registration": "registration",
    "garment": "garment",
    "body": "body",
    "compare": "compare",
    "pairs": "wrinkles/pairs",
    "offsets": "wrinkles/offsets",
}
"""Digests in a stage's record, by name, and the folders of the stages that they are of."""


def take_changes(
    capture: Capture, work: Path, records: Mapping[str, Mapping[str, Any]]
) -> list[StageChanges | list[str]]:
    """What the stages of a take that have been run would do again, each with its own settings; or why nobody can tell.

    Args:
        records: stage.json of each folder.
    """
    found: list[StageChanges | list[str]] = []
    for folder in ("garment", "body", "registration"):
        record = records.get(folder, {})
        if record.get("stage") not in ("extract", "track", REGISTER):
            continue
        try:
            changes = _changes(capture, work, folder, record)
        except InputError as error:
            found.append([str(error)])
        else:
            before = [each for each in found if isinstance(each, StageChanges) and not each.settings]
            found.append(changes.after(before) if folder == "registration" else changes)
    return found


def _changes(capture: Capture, work: Path, folder: str, record: Mapping[str, Any]) -> StageChanges:
    config = record.get("config") or {}
    match folder:
        case "garment":
            return extraction_changes(capture, work / folder, rebuilt(ExtractionSettings, config))
        case "body":
            return tracking_changes(capture, work / folder, rebuilt(TrackingConfig, config))
    body = work / "body" if "body" in record.get("upstream", {}) else None
    settings = rebuilt(RegistrationConfig, config)
    return registration_changes(capture, work / "garment", work / folder, settings, body_folder=body)


def made_from(record: Mapping[str, Any], work: Path) -> dict[str, str]:
    """The folders of the work folder that a stage was made from, and what their digests were."""
    known = {**MADE_FROM, work.resolve().name: "registration"}
    return {known[name]: digest for name, digest in record.get("upstream", {}).items() if name in known}


def linked(record: Mapping[str, Any], records: Mapping[str, Mapping[str, Any]], work: Path) -> list[str]:
    """What a stage was made from inside its work folder, and is not what is there now."""
    words = []
    for folder, digest in made_from(record, work).items():
        now = records.get(folder, {})
        if now.get("status") != "complete":
            words.append(f"{folder} is {'not finished' if now else 'gone'}")
        elif now.get("digest") != digest:
            words.append(f"{folder} has changed")
    return words


def report_changes(work: Path, capture: Capture, records: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """What a report shows and is another by now."""
    report, registered = records["report"], records.get("registration", {})
    if registered.get("status") != "complete":
        return [f"registration is {'not finished' if registered else 'gone'}"]
    now, before = shown_from(work, capture, registered), report.get("upstream", {})
    words = input_changes(now, before)
    return words if words or report.get("schema") == REPORT_SCHEMA else ["drawn by another version of capture4d"]


def rebuilt(kind: type[Settings], said: Mapping[str, Any]) -> Settings:
    """Settings from what a record says of them; those that it does not name are as they are by default.

    Raises:
        InputError: it says what the settings of this version do not know.
    """
    hints = get_type_hints(kind)
    unknown = sorted(set(said) - set(hints))
    if unknown:
        raise InputError(f"made by another version of capture4d, with settings {', '.join(unknown)}")
    return kind(**{name: _value(hints[name], value) for name, value in said.items()})


def _value(hint: Any, value: Any) -> Any:
    """A value of JSON as the field of a settings class has it."""
    if dataclasses.is_dataclass(hint) and isinstance(hint, type) and isinstance(value, dict):
        return rebuilt(hint, value)
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType) and value is not None:
        return _value(next(each for each in inner if each is not type(None)), value)
    if origin is tuple and isinstance(value, list):
        kinds = inner[:1] * len(value) if inner[-1:] == (Ellipsis,) else inner
        return tuple(_value(each, part) for each, part in zip(kinds, value, strict=False))
    if origin is Literal:
        return value
    return float(value) if hint is float and isinstance(value, int) and not isinstance(value, bool) else value
