"""Whether this version still uses what was kept: by the records that stages leave in their folders."""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from capture4d.errors import InputError
from capture4d.files.atomic import read_json
from capture4d.runs.stage import FORMER_STAGES, SCHEMAS
from data_synth.config import SynthConfig, TrainingSetConfig
from data_synth.drapes.config import DrapesConfig
from data_synth.styles.config import StyleSetConfig

__all__ = ["Record", "State", "Verdict", "field_changes", "read_records", "verdict_of_records", "worst"]

State = Literal["current", "old", "unknown"]
_GRAVITY: tuple[State, ...] = ("current", "unknown", "old")

_SETTINGS: Mapping[str, type] = {
    "synth": SynthConfig,
    "synth-drapes": DrapesConfig,
    "synth-styles": StyleSetConfig,
    "training-set": TrainingSetConfig,
}
"""Of the stages that make takes."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether something is still used, and why not, or what stands against knowing it."""

    state: State
    why: str = ""


@dataclass(frozen=True, slots=True)
class Record:
    """A stage.json; `said` is None if it cannot be read."""

    path: Path
    said: Mapping[str, Any] | None


def read_records(paths: Iterable[Path]) -> list[Record]:
    """The records of stages, those farthest up first."""
    return [_read(path) for path in sorted(paths, key=lambda path: (len(path.parts), path))]


def _read(path: Path) -> Record:
    try:
        return Record(path, read_json(path))
    except (InputError, OSError):
        return Record(path, None)


def verdict_of_records(records: Sequence[Record]) -> Verdict:
    """What the records in a folder say of it: it is old if one of them is."""
    if not records:
        return Verdict("unknown", "no stage.json")
    return worst([_of_record(record) for record in records])


def worst(verdicts: Sequence[Verdict]) -> Verdict:
    """The first of the gravest: old, then unknown."""
    return max(verdicts, key=lambda each: _GRAVITY.index(each.state))


def _of_record(record: Record) -> Verdict:
    said = record.said
    name, schema = (None, None) if said is None else (said.get("stage"), said.get("schema"))
    if said is None or not isinstance(name, str) or not isinstance(schema, int):
        return Verdict("unknown", f"damaged {record.path.name}")
    name, config = FORMER_STAGES.get(name, name), said.get("config")
    newest = SCHEMAS.get(name)
    if newest is None:
        return Verdict("unknown", f"stage '{name[:40]}' is not known")
    if not config:  # written by hand, as benchmarks write a take's truth; formats are of what was computed
        return Verdict("current")
    if schema > newest:
        return Verdict("unknown", f"{name}: format {schema}, of a later version")
    if schema < newest:
        return Verdict("old", f"{name}: format {schema}, now {newest}")
    changes = list(field_changes(_SETTINGS[name], config)) if name in _SETTINGS else []
    more = f" and {len(changes) - 1} more" if len(changes) > 1 else ""
    return Verdict("old", f"{name}: {changes[0]}{more}") if changes else Verdict("current")


def field_changes(kind: Any, value: Any, name: str = "") -> Iterator[str]:
    """Settings that a record lacks, or that there are no more, as in "without folds.strip_m".

    As when a stage goes on, what is not there is as good as none.

    Args:
        kind: type of the settings.
        value: what the record says of them.
    """
    kind = _plain(kind)
    if not isinstance(value, Mapping):
        return
    if get_origin(kind) is dict:
        for key, each in value.items():
            yield from field_changes(get_args(kind)[1], each, f"{name}{key}.")
    if not dataclasses.is_dataclass(kind):
        return
    hints = get_type_hints(kind, include_extras=True)
    for field in (field.name for field in dataclasses.fields(kind)):
        if field in value:
            yield from field_changes(hints[field], value[field], f"{name}{field}.")
        elif type(None) not in get_args(hints[field]):
            yield f"without {name}{field}"
    yield from (f"with {name}{key}" for key in value if key not in hints and value[key] is not None)


def _plain(hint: Any) -> Any:
    """A type without what stands beside it, and without None."""
    if get_origin(hint) is Annotated:
        return _plain(get_args(hint)[0])
    if get_origin(hint) in (Union, types.UnionType):
        return _plain(next(each for each in get_args(hint) if each is not type(None)))
    return hint
