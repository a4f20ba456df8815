"""The stage: a style set on disk in, a model out; killed and continued to the same digest, refused where stale."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture4d.captures.drapes.style_sets import StyleSet, read_style_set
from capture4d.errors import InputError, StaleError
from retarget.mixture import learning, stage
from retarget.mixture.config import NetworkConfig, StylesConfig
from retarget.mixture.lesson import PARTS
from retarget.mixture.model_files import load_styled_garment
from tests.unit.retarget.mixture.conftest import motion, write_style_set

CONFIG = StylesConfig(members=2, network=NetworkConfig(hidden=8, epochs=4), checkpoint_every=2)


@pytest.fixture(scope="module")
def folder(style_set: StyleSet, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("styles") / "set"
    write_style_set(place, style_set)
    return place


def test_what_lies_on_disk_is_read(folder: Path, style_set: StyleSet):
    found = read_style_set(folder)
    assert found.ranges == style_set.ranges
    for one, other in zip(found.pairs, style_set.pairs, strict=True):
        assert (one.name, one.role) == (other.name, other.role)
        np.testing.assert_array_equal(one.drapes.vertices, other.drapes.vertices)
        np.testing.assert_array_equal(one.canonical, other.canonical)


def test_a_model_is_learned_once_and_a_killed_run_ends_in_the_same(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    whole = stage.run(folder, tmp_path / "a", CONFIG)
    told = json.loads((tmp_path / "a" / "errors.json").read_text())
    assert set(told["errors"]) == set(PARTS)
    rows = [json.loads(line) for line in (tmp_path / "a" / "metrics.jsonl").read_text().splitlines()]
    assert [row["network"] for row in rows] == ["network-0"] * 4 + ["network-1"] * 4
    assert not (tmp_path / "a" / "checkpoints").exists()

    real = learning.Trainer.__call__

    def killed(self: learning.Trainer, name: str, *args: object, **kwargs: object) -> object:
        if name == "network-1":
            raise KeyboardInterrupt
        return real(self, name, *args, **kwargs)  # pyright: ignore[reportArgumentType]

    monkeypatch.setattr(learning.Trainer, "__call__", killed)
    with pytest.raises(KeyboardInterrupt):
        stage.run(folder, tmp_path / "b", CONFIG)
    monkeypatch.undo()
    assert stage.run(folder, tmp_path / "b", CONFIG).digest == whole.digest

    monkeypatch.setattr(stage, "learn_styles", lambda *_, **__: pytest.fail("it has been learned"))
    assert stage.run(folder, tmp_path / "b", CONFIG).digest == whole.digest
    with pytest.raises(StaleError, match="other settings"):
        stage.run(folder, tmp_path / "b", replace(CONFIG, members=1))
    garment = load_styled_garment(tmp_path / "b")
    assert np.isfinite(garment.vertices(motion([0.2]), [0.5], {"length": 0.7})).all()


def test_a_set_that_is_not_there_or_not_finished_is_one_line(folder: Path, tmp_path: Path):
    with pytest.raises(InputError, match="expected the output of 'synth-styles', found none; run: capture4d"):
        stage.run(tmp_path / "none", tmp_path / "model", CONFIG)
    assert not (tmp_path / "model").exists()
    record = json.loads((folder / "stage.json").read_text())
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "stage.json").write_text(json.dumps({**record, "status": "running"}))
    with pytest.raises(InputError, match="'synth-styles' is not finished"):
        stage.run(tmp_path / "set", tmp_path / "model", CONFIG)
