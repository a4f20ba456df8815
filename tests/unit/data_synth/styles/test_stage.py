"""A style set on disk: read back whole, finished to the same bytes after a kill, one line where it is damaged."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from capture4d.body.skinning import ShapedBody
from capture4d.captures.drapes.style_sets import read_style_set
from capture4d.errors import InputError, StaleError
from data_synth.drapes import stage as drapes
from data_synth.drapes.config import SolverConfig
from data_synth.styles import stage
from data_synth.styles.config import StyleSetConfig

CONFIG = StyleSetConfig(
    garment="necktie",
    styles={"length_m": (0.3, 0.5), "width_m": (0.06, 0.1)},
    shapes=((0.0,), (1.0,)),
    prototypes=2,
    poses=2,
    unseen_poses=1,
    test_pairs=1,
    off_grid=1,
    seen_poses=1,
    vertices=110,
    solver=SolverConfig(frames=25),
)


@pytest.fixture(autouse=True)
def _on_the_mannequin(person: ShapedBody, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (stage, drapes):
        monkeypatch.setattr(module, "load_anny", lambda: person.body)


@pytest.fixture(scope="module")
def made(person: ShapedBody, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("styles") / "set"
    with pytest.MonkeyPatch.context() as patched:
        for module in (stage, drapes):
            patched.setattr(module, "load_anny", lambda: person.body)
        result = stage.run(folder, CONFIG)
    assert result.frames == 2 * 3 + 2 * 2
    return folder


def test_a_set_is_read_as_it_was_made(made: Path):
    found = read_style_set(made)
    assert [pair.role for pair in found.pairs] == ["prototype", "prototype", "test", "test"]
    assert [len(pair.drapes.numbers) for pair in found.pairs] == [3, 3, 2, 2]
    assert found.unseen_poses == 1
    assert found.ranges.style == {"length_m": (0.3, 0.5), "width_m": (0.06, 0.1)}
    assert len(found.canonical.vertices) == 2 * 2 * 2 + 1
    assert found.canonical.test.sum() == 2
    for pair in found.pairs:
        row = np.flatnonzero((found.canonical.vertices == pair.canonical).all(axis=(1, 2)))
        assert found.canonical.test[row].all() == (pair.role == "test")
        assert {name: pair.drapes.style[name] for name in found.ranges.style} == dict(
            zip(found.ranges.style, found.canonical.styles[row[0]].tolist(), strict=True)
        )
    first, *others = (pair.drapes for pair in found.pairs)
    for drapes_ in others:  # a pose is told by its number, whoever takes it
        np.testing.assert_array_equal(drapes_.rotations, first.rotations[: len(drapes_.numbers)])
    fits = json.loads((made / "styles.json").read_text())["convex_fits_mm"]
    assert [each["prototypes"] for each in fits] == [1, 2]
    assert fits[1]["worst"] < fits[0]["worst"]


def test_what_a_kill_left_is_finished_to_the_same_bytes(made: Path, tmp_path: Path):
    folder = tmp_path / "set"
    shutil.copytree(made, folder)
    before = json.loads((folder / "stage.json").read_text())["digest"]
    lost = [folder / "canonical" / "000003.npz", folder / "pairs" / "prototype-02" / "shards" / "000001.npz"]
    bytes_before = [path.read_bytes() for path in lost]
    for path in (*lost, folder / "canonical.npz"):
        path.unlink()
    assert stage.run(folder, CONFIG).digest == before
    assert [path.read_bytes() for path in lost] == bytes_before
    with pytest.raises(StaleError, match="seed"):
        stage.run(folder, StyleSetConfig(**{**_fields(CONFIG), "seed": 1}))


def _fields(config: StyleSetConfig) -> dict:
    return {name: getattr(config, name) for name in config.__dataclass_fields__}


@pytest.mark.parametrize(
    ("entry", "value", "said"),
    [
        ("unseen_poses", -1, "unseen_poses: expected a whole number"),
        ("style_ranges", {"length_m": [0.5, 0.3]}, "style_ranges.length_m: expected the least first"),
        ("style_ranges", {"length_m": [0.3, 0.5]}, "styles: expected 1 numbers, found 2"),
        ("shape_ranges", [[0, 1], 3], "shape_ranges: expected the least and the most"),
        ("pairs", {"a/b": {"role": "test", "canonical": 0}}, "pairs: expected roles"),
        ("pairs", {"test-01": {"role": "test", "canonical": 0}}, "expected at least one prototype"),
        ("pairs", {"prototype-01": {"role": "prototype", "canonical": 99}}, "expected one of 9 A-poses, found 99"),
        ("pairs", {"prototype-09": {"role": "prototype", "canonical": 0}}, "expected the output of 'synth-drapes'"),
    ],
)
def test_a_damaged_description_is_one_line(made: Path, tmp_path: Path, entry: str, value: object, said: str):
    folder = tmp_path / "set"
    shutil.copytree(made, folder)
    about = json.loads((folder / "styles.json").read_text())
    (folder / "styles.json").write_text(json.dumps({**about, entry: value}))
    with pytest.raises(InputError, match=said) as raised:
        read_style_set(folder)
    assert raised.value.where is not None
    assert "\n" not in str(raised.value)


def test_damaged_drapes_are_one_line_with_their_file(made: Path, tmp_path: Path):
    folder = tmp_path / "set"
    shutil.copytree(made, folder)
    shard = folder / "pairs" / "test-01" / "shards" / "000001.npz"
    with np.load(shard) as arrays:
        values = dict(arrays)
    for name, value in (
        ("vertices", values["vertices"][:, :-1]),
        ("vertices", values["vertices"] * np.float32(np.nan)),
        ("rotations", values["rotations"] * 2),
        ("kept", values["kept"].astype(np.int32)),
        ("drapes", values["drapes"][::-1].copy()),
    ):
        np.savez(shard, **{**values, name: value})
        with pytest.raises(InputError) as raised:
            read_style_set(folder)
        assert str(shard.parent) in str(raised.value)
    shard.write_bytes(shard.read_bytes()[:400])
    with pytest.raises(InputError, match=r"000001\.npz"):
        read_style_set(folder)
