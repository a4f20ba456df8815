"""A card says what a folder was made from, whose it is, and how good; what nobody stated is said to be missing."""

from pathlib import Path
from typing import Any

import pytest

from capture4d.app.cards.card import UNKNOWN, Card, Part, write_card
from capture4d.app.cards.sources import card_of, with_card
from capture4d.errors import InputError
from capture4d.files.atomic import read_json, write_json
from capture4d.motions.sources import CMU
from capture4d.runs.stage import StageResult
from tests.command_line import run
from tests.moving_garment import write_moving_work


def stage_folder(folder: Path, stage: str, **more: Any) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    record = {"stage": stage, "schema": 1, "config": {}, "upstream": {}, "status": "complete", "digest": "d" * 64}
    write_json(folder / "stage.json", record | more)
    return folder


def take(root: Path, name: str, licence: str | None) -> Path:
    """A work folder that knows its capture."""
    capture = root / f"{name}-capture"
    capture.mkdir(parents=True)
    write_json(
        capture / "capture.json", {"format": 1, "name": name} | ({} if licence is None else {"licence": licence})
    )
    work = root / name
    stage_folder(work / "registration", "register", sources={"capture": str(capture)})
    return work


def model(root: Path, licences: list[str | None], **config: Any) -> Path:
    works = {f"take{at}": take(root, f"take{at}", licence) for at, licence in enumerate(licences)}
    return stage_folder(
        root / "model", "fit", config=config, upstream={name: name * 8 for name in works},
        sources={name: str(path) for name, path in works.items()},
    )  # fmt: skip


def test_takes_of_one_licence_give_it_on(tmp_path: Path):
    card = card_of(model(tmp_path, ["CC-BY-4.0", "CC-BY-4.0"]))
    assert card.licence == "CC-BY-4.0"
    assert [(part.name, part.place, part.licence) for part in card.parts] == [
        ("take0", "take0", "CC-BY-4.0"), ("take1", "take1", "CC-BY-4.0"),
    ]  # fmt: skip
    assert card.notes == []


def test_parts_of_different_licences_are_not_mixed_unsaid(tmp_path: Path):
    (note,) = card_of(model(tmp_path, ["CC-BY-4.0", "research only"], licence="research only")).notes
    assert "different licences: CC-BY-4.0; research only" in note


def test_what_nobody_stated_is_missing_not_guessed(tmp_path: Path):
    card = card_of(model(tmp_path, ["CC-BY-4.0", None]))
    assert card.licence == UNKNOWN
    assert "No licence is stated of the whole, take1" in card.notes[-1]
    said = card_of(model(tmp_path / "said", [None], licence="ours"))
    assert said.licence == "ours"
    assert said.notes == ["No licence is stated of take0: ask whoever made it before handing this on."]


def test_figures_stand_beside_the_command_that_prints_them(tmp_path: Path):
    folder = model(tmp_path, ["CC0"])
    write_json(folder / "fit.json", {"kernel": {"validation": {"vertex_error_mm": 4.25}}, "linear": {"ridge": 1.0}})
    with_card(StageResult(folder, ""))
    told = read_json(folder / "card.json")
    assert told["figures"] == [
        {"name": "kernel: error of a vertex, validation frames", "value": 4.25, "unit": "mm",
         "command": "capture4d fit WORK --output model"}
    ]  # fmt: skip
    page = (folder / "README.md").read_text()
    head, _, rest = page.removeprefix("---\n").partition("---\n")
    assert 'license: "other"' in head
    assert 'license_name: "CC0"' in head
    assert "| kernel: error of a vertex, validation frames | 4.25 mm |" in rest
    assert str(tmp_path) not in page + (folder / "card.json").read_text(), "nobody's folders are told"


def test_an_export_is_told_of_its_motion_and_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    work = tmp_path / "dance"
    write_moving_work(work, 3)
    record = read_json(work / "registration" / "stage.json")
    made = model(tmp_path, ["CC0"])
    with_card(StageResult(made, ""))
    (tmp_path / "cmu").mkdir()
    (tmp_path / "cmu" / "12_01.bvh").touch()
    sources = {"model": str(made), "poses": str(tmp_path / "cmu" / "12_01.bvh")}
    write_json(work / "registration" / "stage.json", record | {"sources": sources})
    assert run("export", work, "--format", "pc2", "--quiet") == 0
    card = read_json(work / "exports" / "card.json")
    assert card["title"] == "dance"
    assert card["figures"][0]["value"] == pytest.approx(0, abs=1e-4)
    assert CMU in card["notes"][0]
    assert "CC0" in card["notes"][0]
    before = (work / "exports" / "card.json").read_bytes()
    assert run("export", work, "--format", "pc2", "--quiet") == 0
    after = read_json(work / "exports" / "card.json")
    assert {**after, "made": ""} == {**card, "made": ""}, before


def test_cells_keep_their_columns_and_other_folders_have_no_card(tmp_path: Path):
    part = Part("a|b", "line\nbreak", "x", [UNKNOWN])
    card = Card("t", "learned garment", UNKNOWN, [part], [], {"capture4d": "1"}, "c", "")
    write_card(tmp_path, card)
    assert r"| a\|b | line break | not stated | `x` |" in (tmp_path / "README.md").read_text()
    with pytest.raises(InputError, match="expected a folder of fit"):
        card_of(stage_folder(tmp_path / "other", "track"))
