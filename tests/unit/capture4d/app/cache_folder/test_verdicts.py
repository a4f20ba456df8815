"""A record tells whether this version goes on with what it belongs to."""

from copy import deepcopy
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from capture4d.app.cache_folder.verdicts import Verdict, field_changes, read_records, verdict_of_records
from capture4d.runs.stage import SCHEMAS
from data_synth.config import PRESETS, TRAINING_SETS, SynthConfig, TrainingSetConfig
from data_synth.drapes.config import DrapesConfig
from data_synth.styles.config import StyleSetConfig
from tests.unit.capture4d.app.cache_folder.conftest import Record

FOLDED = next(config for config in PRESETS.values() if config.folds is not None)


def of(folder: Path) -> Verdict:
    return verdict_of_records(read_records([folder / "stage.json"]))


@pytest.mark.parametrize(
    ("kind", "config"),
    [
        *((SynthConfig, config) for config in PRESETS.values()),
        *((TrainingSetConfig, config) for config in TRAINING_SETS.values()),
        (DrapesConfig, DrapesConfig()),
        (StyleSetConfig, StyleSetConfig()),
    ],
)
def test_settings_of_this_version_have_no_changes(kind: type, config: Any):
    assert list(field_changes(kind, asdict(config))) == []


def test_fields_that_came_and_went_are_named_where_they_lie():
    said = deepcopy(asdict(FOLDED))
    del said["folds"]["wide"]["sweeps"]
    said["simulation"]["gravity"] = 9.81
    assert list(field_changes(SynthConfig, said)) == ["with simulation.gravity", "without folds.wide.sweeps"]
    (name, _), *_ = TRAINING_SETS["tiny-train"].takes.items()
    in_set = deepcopy(asdict(TRAINING_SETS["tiny-train"]))
    del in_set["takes"][name]["frames"]
    assert list(field_changes(TrainingSetConfig, in_set)) == [f"without takes.{name}.frames"]


def test_what_is_not_there_is_as_good_as_none():
    said = asdict(PRESETS["tiny"])
    del said["print"], said["garment"], said["folds"]  # takes were made before there were any
    assert list(field_changes(SynthConfig, {**said, "hat": None})) == []


@pytest.mark.parametrize(
    ("said", "verdict"),
    [
        ({}, Verdict("current")),
        (
            {"schema": SCHEMAS["synth"] - 1},
            Verdict("old", f"synth: format {SCHEMAS['synth'] - 1}, now {SCHEMAS['synth']}"),
        ),
        (
            {"schema": SCHEMAS["synth"] + 1},
            Verdict("unknown", f"synth: format {SCHEMAS['synth'] + 1}, of a later version"),
        ),
        ({"schema": "3"}, Verdict("unknown", "damaged stage.json")),
        ({"config": {**asdict(PRESETS["tiny"]), "hat": 1, "shoes": 2}}, Verdict("old", "synth: with hat and 1 more")),
    ],
)
def test_what_a_record_says(record: Record, said: dict[str, Any], verdict: Verdict):
    assert of(record("takes/a", **said)) == verdict


def test_a_stage_that_is_not_known_and_a_record_that_is_cut_off_tell_nothing(record: Record):
    folder = record("takes/a")
    (folder / "stage.json").write_text('{"stage": "weave", "schema": 1, "config": {}}')
    assert of(folder) == Verdict("unknown", "stage 'weave' is not known")
    (folder / "stage.json").write_text('{"stage": "we')
    assert of(folder) == Verdict("unknown", "damaged stage.json")
    assert verdict_of_records([]).state == "unknown"


def test_former_names_of_stages_are_known(record: Record):
    folder = record("works/a", "wrinkles maps", config={"x": 1})
    text = (folder / "stage.json").read_text()
    (folder / "stage.json").write_text(text.replace("wrinkles maps", "pairs"))
    assert of(folder).state == "current"
