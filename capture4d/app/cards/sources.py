"""The card of a folder, from what lies in it: its stage.json, what that names, and the figures beside it.

Licences: a model says its own (`fit --licence`); a capture may say one in the entry "licence" of its capture.json; what
was made from these has theirs. A licence that nobody has stated is said to be missing, never guessed.
"""

from __future__ import annotations

import platform
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from capture4d.app.cards.card import CARD, MIXED, UNKNOWN, Card, Figure, Part, write_card
from capture4d.errors import InputError
from capture4d.files.atomic import read_json
from capture4d.motions.sources import acknowledgement
from capture4d.runs.stage import StageResult, read_record

__all__ = ["card_of", "with_card"]

KINDS: Mapping[str, str] = {
    "fit": "learned garment",
    "fit-styles": "learned garment with styles",
    "wrinkles train": "wrinkle network",
    "offsets train": "network of offset images",
    "export": "moving garment",
    "export-onnx": "learned model in ONNX form",
}
"""Of the folders that have cards, by stage."""
COMMANDS: Mapping[str, str] = {
    "fit": "capture4d fit WORK --output {}",
    "fit-styles": "capture4d fit-styles DRAPES --output {}",
    "wrinkles train": "capture4d wrinkles train WORK --output {}",
    "offsets train": "capture4d offsets train DRAPES --output {}",
    "export": "capture4d export WORK --output {}",
    "export-onnx": "capture4d export-onnx MODEL --output {}",
}
PACKAGES = ("capture4d", "numpy", "torch")
NOT_GIVEN = ("", "none given")
DEPTH = 6
"""Folders that are followed back, one made from the next."""


def with_card(result: StageResult) -> StageResult:
    """What a stage returned, its folder given a card."""
    folder = result.path if result.path.is_dir() else result.path.parent
    write_card(folder, card_of(folder))
    return result


def card_of(folder: Path) -> Card:
    """What is known of a finished folder.

    Raises:
        InputError: it is not one of those that have cards.
    """
    record = read_record(folder / "stage.json")
    stage = record.get("stage", "")
    if stage not in KINDS:
        raise InputError(f"expected a folder of {', '.join(KINDS)}, found one of '{stage}'", where=folder)
    command = COMMANDS[stage].format(folder.name)
    parts = list(_parts(record))
    return Card(
        title=folder.resolve().name if stage != "export" else folder.resolve().parent.name,
        kind=KINDS[stage],
        licence=_licence(record, parts),
        parts=parts,
        figures=list(_figures(folder, stage, command)),
        versions={**{name: version(name) for name in PACKAGES}, "python": platform.python_version()},
        command=command,
        made=str(record.get("finished", "")),
    )


def _licence(record: Mapping[str, Any], parts: list[Part]) -> str:
    """What was said of the folder itself; or else what all its parts are under."""
    config = record.get("config")
    said = config.get("licence") if isinstance(config, dict) else None
    if isinstance(said, str) and said not in NOT_GIVEN:
        return said
    found = {each for part in parts for each in part.licences}
    if len(found) == 1:
        return found.pop()
    return UNKNOWN if not found or UNKNOWN in found else MIXED


def _parts(record: Mapping[str, Any]) -> Iterator[Part]:
    """A part for each input that the record names; a motion's makers may ask to be named."""
    sources = record.get("sources") or {}
    only = Path(next(iter(sources.values()))) if len(sources) == 1 else None
    for name, digest in (record.get("upstream") or {}).items():
        given = sources.get(name)
        place = Path(given) if given is not None else only
        yield Part(name, "" if place is None else place.name, str(digest), sorted(_licences_of(place, DEPTH)))


def _licences_of(place: Path | None, depth: int) -> set[str]:
    """What a folder, or a file, says of who may use it; followed back through what it was made from."""
    if place is None or depth == 0:
        return {UNKNOWN}
    if place.is_file():
        return {acknowledgement(place) or UNKNOWN}
    for name in (CARD, "capture.json"):
        told = read_json(place / name) if (place / name).is_file() else {}
        said = told.get("licence")
        if isinstance(said, str) and said not in (*NOT_GIVEN, UNKNOWN, MIXED):
            return {said}
        if told.get("parts"):
            return {str(each) for part in told["parts"] for each in part.get("licences", [UNKNOWN])}
    found: set[str] = set()
    for path in (place, place / "registration", place / "garment", place / "retarget"):
        if (path / "stage.json").is_file():
            sources = (read_record(path / "stage.json").get("sources") or {}).values()
            for each in map(Path, sources):
                if each.resolve() != place.resolve():
                    found |= _licences_of(each, depth - 1)
    return found or {UNKNOWN}


# --- figures -----------------------------------------------------------------------------------------------------


def _figures(folder: Path, stage: str, command: str) -> Iterator[Figure]:
    match stage:
        case "export" if (folder / "export.json").is_file():
            for kind, told in read_json(folder / "export.json")["files"].items():
                yield Figure(f"{kind}: largest error of a vertex that was read back", told["error_mm"], "mm", command)
        case "export-onnx" if (folder / "onnx.json").is_file():
            told = read_json(folder / "onnx.json")
            yield Figure("largest difference to the model", told["largest"], told["unit"], command)
            yield Figure("time of a frame in ONNX Runtime, one thread", told["onnx_ms"], "ms", command)
            yield Figure(f"the same in {told['ours_by']}", told["ours_ms"], "ms", command)
        case "fit" if (folder / "fit.json").is_file():
            yield from _fit_figures(read_json(folder / "fit.json"), command)
        case "wrinkles train" if (folder / "held_out.json").is_file():
            for key, value in _numbers(read_json(folder / "held_out.json")):
                yield Figure(key, value, "", command)
        case _:
            pass


def _fit_figures(told: Mapping[str, Any], command: str) -> Iterator[Figure]:
    for name in ("linear", "lstm", "kernel", "ensemble"):
        found = told.get(name)
        for role in ("training", "validation"):
            each = found.get(role) if isinstance(found, dict) else None
            if isinstance(each, dict) and isinstance(each.get("vertex_error_mm"), int | float):
                yield Figure(f"{name}: error of a vertex, {role} frames", each["vertex_error_mm"], "mm", command)


def _numbers(told: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, float]]:
    for key, value in told.items():
        if isinstance(value, dict):
            yield from _numbers(value, f"{before}{key}, ")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield f"{before}{key}", float(value)
