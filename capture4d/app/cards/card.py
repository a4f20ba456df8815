"""A card as a value, as JSON, and as a page in the form of Hugging Face's model cards.

References: https://huggingface.co/docs/hub/model-cards: a README.md whose head is YAML.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from capture4d.files.atomic import write_bytes, write_json

__all__ = ["CARD", "MIXED", "PAGE", "UNKNOWN", "Card", "Figure", "Part", "write_card"]

FORMAT = 1
CARD, PAGE = "card.json", "README.md"
UNKNOWN = "not stated"
"""The licence of a part of which nobody has said one."""
MIXED = "those of its parts"
"""The licence of what was made from parts that have several."""


@dataclass(frozen=True, slots=True)
class Part:
    """Something that a model or an export was made from."""

    name: str
    """Such as "registration" or "motion"."""
    place: str
    """Name of the file or folder, without the way to it; may be empty."""
    digest: str
    licences: Sequence[str]
    """That it is under, all of them; `UNKNOWN` where something in it has none."""

    @property
    def licence(self) -> str:
        return "; ".join(self.licences)


@dataclass(frozen=True, slots=True)
class Figure:
    """How good it is."""

    name: str
    value: float
    unit: str
    command: str
    """That prints it."""


@dataclass(frozen=True, slots=True)
class Card:
    """What is told of a model or an export."""

    title: str
    kind: str
    """ "learned garment", "wrinkle network", "export", ... """
    licence: str
    parts: Sequence[Part]
    figures: Sequence[Figure]
    versions: dict[str, str]
    command: str
    made: str
    """When, as stage.json has it."""

    @property
    def notes(self) -> list[str]:
        """What has to be said of licences."""
        found = {each for part in self.parts for each in part.licences} | {self.licence}
        stated, said = sorted(found - {UNKNOWN, MIXED}), []
        if len(stated) > 1:
            each = "; ".join(stated)
            said.append(f"Parts are under different licences: {each}. Whoever hands this on has to keep all of them.")
        silent = [part.name for part in self.parts if UNKNOWN in part.licences]
        if self.licence == UNKNOWN:
            silent.insert(0, "the whole")
        if silent:
            said.append(f"No licence is stated of {', '.join(silent)}: ask whoever made it before handing this on.")
        return said


def write_card(folder: Path, card: Card) -> list[Path]:
    """Write card.json and README.md into a folder; their paths."""
    write_json(folder / CARD, {"format": FORMAT, **asdict(card), "notes": card.notes})
    write_bytes(folder / PAGE, _page(card).encode())
    return [folder / CARD, folder / PAGE]


def _page(card: Card) -> str:
    head = {
        "license": "other",
        "license_name": card.licence,
        "library_name": "capture4d",
        "tags": ["garment", "cloth", "mesh", card.kind],
    }
    lines = ["---", *(f"{key}: {json.dumps(value, ensure_ascii=False)}" for key, value in head.items()), "---", ""]
    lines += [f"# {_plain(card.title)}", "", f"A {card.kind}, made by capture4d {card.versions['capture4d']}.", ""]
    lines += ["## Licence", "", _plain(card.licence), "", *(f"> {_plain(note)}\n" for note in card.notes)]
    lines += ["## Made from", "", "| part | from | licence | digest |", "|---|---|---|---|"]
    lines += [
        f"| {_cell(part.name)} | {_cell(part.place)} | {_cell(part.licence)} | `{part.digest[:16]}` |"
        for part in card.parts
    ]
    if card.figures:
        lines += ["", "## Figures", "", "| figure | value | command |", "|---|---|---|"]
        lines += [
            f"| {_cell(each.name)} | {each.value:.4g} {each.unit} | `{_cell(each.command)}` |" for each in card.figures
        ]
    lines += ["", "## How it was made", "", f"`{card.command}`", ""]
    lines += [f"- {name} {version}" for name, version in card.versions.items()]
    lines += [f"- finished {card.made}", ""]
    return "\n".join(lines)


def _plain(text: str) -> str:
    return " ".join(text.split())


def _cell(text: str) -> str:
    return _plain(text).replace("|", "\\|")
