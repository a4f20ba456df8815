"""A set of drapes on disk: whole, the same in any order, continued after a kill, and refused where it cannot be."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture4d.app.report.drapes import angle_charts, read_set, write_page
from capture4d.body.skinning import ShapedBody
from capture4d.errors import InputError, StaleError
from capture4d.files.records import load_body, load_garment
from data_synth.drapes import stage
from data_synth.drapes.config import DrapesConfig, SolverConfig

CONFIG = DrapesConfig(garment="necktie", samples=5, shard=2, vertices=120, solver=SolverConfig(frames=40))


@pytest.fixture(autouse=True)
def _on_the_mannequin(person: ShapedBody, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage, "load_anny", lambda: person.body)


def test_a_set_has_everything_that_a_learner_needs(tmp_path: Path):
    result = stage.run(tmp_path, CONFIG)
    assert result.frames == 5
    shards = [np.load(path) for path in sorted((tmp_path / "shards").iterdir())]
    assert [len(each["drapes"]) for each in shards] == [2, 2, 1]
    garment, body = load_garment(tmp_path / "garment.npz"), load_body(tmp_path / "body.npz")
    about = json.loads((tmp_path / "drapes.json").read_text())
    for shard in shards:
        count = len(shard["drapes"])
        assert shard["vertices"].shape == (count, len(garment.template.vertices), 3)
        assert shard["rotations"].shape == (count, len(body.joint_names), 3, 3)
        assert shard["styles"].shape == (count, len(about["style"]))
        assert shard["quality"].shape == (count, len(about["quality"]))
        assert np.isfinite(shard["vertices"]).all()
    split = json.loads((tmp_path / "split.json").read_text())
    numbered = [*split["train"], *split["validation"], *split["test"], *map(int, split["pruned"])]
    assert sorted(numbered) == [1, 2, 3, 4, 5]
    assert set(split["pruned"]) == {str(number) for number in result.failed}
    assert len((tmp_path / "quality.jsonl").read_text().splitlines()) == 5
    drapes = read_set(tmp_path)
    np.testing.assert_allclose(100 * drapes.cuts.mean(axis=1), drapes.quality["cut_percent"], atol=1e-9)
    np.testing.assert_array_equal(drapes.kept, [not reasons for reasons in drapes.reasons])
    page = write_page(tmp_path).read_text()
    assert "Drapes of a necktie" in page
    assert page.count("<svg") == len(angle_charts(drapes)) > 0


def test_what_a_kill_left_is_finished_to_the_same_bytes(tmp_path: Path):
    first = stage.run(tmp_path / "a", CONFIG)
    shard = tmp_path / "a" / "shards" / "000002.npz"
    before, kept = shard.read_bytes(), (tmp_path / "a" / "shards" / "000001.npz").stat().st_mtime_ns
    shard.unlink()
    assert stage.run(tmp_path / "a", CONFIG).digest == first.digest
    assert shard.read_bytes() == before
    assert (tmp_path / "a" / "shards" / "000001.npz").stat().st_mtime_ns == kept


def test_shards_are_the_same_bytes_in_any_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, backwards: Callable[..., Iterator[None]]
):
    first = stage.run(tmp_path / "a", CONFIG)
    monkeypatch.setattr(stage, "run_jobs", backwards)
    assert stage.run(tmp_path / "b", CONFIG).digest == first.digest


@pytest.fixture
def backwards() -> Callable[..., Iterator[None]]:
    """Runs jobs from the last to the first, as other workers might."""

    def run(do, jobs, *, prepare, **_):
        prepared = prepare()
        for job in reversed(jobs):
            yield do(prepared, job)

    return run


def test_another_seed_is_another_set_and_not_mixed_with_this(tmp_path: Path):
    first = stage.run(tmp_path / "a", replace(CONFIG, samples=2))
    assert stage.run(tmp_path / "b", replace(CONFIG, samples=2, seed=1)).digest != first.digest
    with pytest.raises(StaleError, match="seed"):
        stage.run(tmp_path / "a", replace(CONFIG, samples=2, seed=1))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"style": ("sleeve_length=1",)}, "of a necktie length_m, width_m; found 'sleeve_length=1'"),
        ({"style": ("length_m=long",)}, "length_m: expected a number, found 'long'"),
        ({"style": ("length_m=9",)}, "expected .* found 9"),
        ({"beta": (0.0,) * 40}, "--beta"),
    ],
)
def test_a_style_or_shape_that_is_none_is_refused(tmp_path: Path, changes: dict, said: str):
    with pytest.raises(InputError, match=said):
        stage.run(tmp_path / "set", replace(CONFIG, **changes))
    assert not (tmp_path / "set").exists()


def test_drapes_are_split_at_random_and_each_is_in_one_part():
    parts = stage.split_drapes(range(1, 101), (0.1, 0.2), np.random.default_rng(0))
    assert {name: len(part) for name, part in parts.items()} == {"validation": 10, "test": 20, "train": 70}
    assert sorted(number for part in parts.values() for number in part) == list(range(1, 101))
