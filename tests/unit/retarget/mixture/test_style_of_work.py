"""From an animated garment back to its style, and on to another wearer; what cannot be is one line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from capture4d.captures.garment_scans import save_garment_scan
from capture4d.captures.work_folder import load_registration
from capture4d.cli.main import main
from capture4d.files.atomic import read_json, write_json
from capture4d.files.records import load_garment, save_garment, save_poses
from capture4d.pipeline import fit_style
from capture4d.runs.stage import open_stage
from capture4d.types import GarmentScan, Mesh
from retarget.mixture import style_of_work
from retarget.mixture.config import StyleFitConfig, StylesConfig
from retarget.mixture.model_files import load_styled_garment
from retarget.mixture.stage import run as fit_styles
from retarget.mixture.style_fit import SeenFrame, StyleFit
from retarget.mixture.styled_garment import StyledGarment
from tests.unit.retarget.mixture.conftest import ALONG, AROUND, made_style_set, motion, write_style_set

ANGLES = [0.05, 0.3, 0.62, 0.9]


def run(*words: str | Path) -> int:
    with pytest.raises(SystemExit) as exit_:
        main([str(word) for word in words])
    return int(exit_.value.code or 0)


@pytest.fixture(scope="module")
def styled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model of kernels with named borders, a motion, and WORK, in which the model's garment of one style moves."""
    folder = tmp_path_factory.mktemp("styled")
    write_style_set(folder / "set", made_style_set())
    fit_styles(folder / "set", folder / "model", StylesConfig(members=0))
    ring = np.arange(AROUND, dtype=np.int32)
    garment = load_garment(folder / "model" / "garment.npz")
    save_garment(
        folder / "model" / "garment.npz", replace(garment, loops={"waist": ring, "hem": ring + AROUND * (ALONG - 1)})
    )
    save_poses(folder / "walk.npz", motion(ANGLES, np.array([[0, 0.1 * k, 0] for k in range(4)])))
    words = "--style", "0.7", "--beta", "0.5", "--workers", "1"
    assert run("animate", folder / "model", "--poses", folder / "walk.npz", "--output", folder / "work", *words) == 0
    return folder


def test_numbers_in_their_order_are_those_by_name(styled: Path, tmp_path: Path):
    words = "--style", "length=0.7", "--beta", "0.5", "--workers", "1"
    assert run("animate", styled / "model", "--poses", styled / "walk.npz", "--output", tmp_path / "named", *words) == 0
    ours, theirs = (
        load_registration(folder / "registration").vertices for folder in (styled / "work", tmp_path / "named")
    )
    np.testing.assert_array_equal(ours, theirs)


def test_the_style_of_registered_frames_is_found_and_worn_by_others(
    styled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert run("fit-style", styled / "model", styled / "work", "--output", tmp_path / "style.json") == 0
    said = capsys.readouterr().out
    about = read_json(tmp_path / "style.json")
    assert about["style"]["length"] == pytest.approx(0.7, abs=0.02)
    assert about["beta"][0] == pytest.approx(0.5, abs=0.1)
    assert about["residual_mm"] < 8.0
    assert about["source"] == "registration"
    assert about["verdict"] == "good"
    assert [*about["frames"]] == ["0", "1", "2", "3"]
    assert f"length {about['style']['length']:.3f}" in said
    worn = tmp_path / "worn"
    words = "--style", f"@{tmp_path / 'style.json'}", "--beta", "-0.6", "--workers", "1"
    assert run("animate", styled / "model", "--poses", styled / "walk.npz", "--output", worn, *words) == 0
    garment = load_styled_garment(styled / "model")
    poses = motion(ANGLES, np.array([[0, 0.1 * k, 0] for k in range(4)]))
    np.testing.assert_array_equal(
        load_registration(worn / "registration").vertices, garment.vertices(poses, [-0.6], about["style"])
    )


def test_the_style_of_scans_is_found(styled: Path, tmp_path: Path):
    """Every other vertex is missing, the borders are named, and nothing is registered."""
    work = tmp_path / "work"
    sequence = load_registration(styled / "work" / "registration")
    garment = load_garment(styled / "model" / "garment.npz")
    stage = open_stage(work / "garment", name="extract", schema=1, config={}, upstream={})
    for frame_id, vertices in zip(sequence.frame_ids.tolist(), np.array(sequence.vertices), strict=True):
        points = np.concatenate([vertices[loop] for loop in garment.loops.values()])
        rows = np.repeat(np.arange(2, dtype=np.int32), AROUND)
        kept = np.arange(len(garment.template.faces)) % 3 > 0
        mesh = Mesh(vertices.astype(np.float32), garment.template.faces[kept])
        save_garment_scan(stage.frame_path(frame_id), GarmentScan(mesh, points, rows, tuple(garment.loops), frame_id))
    write_json(work / "garment" / "done.json", {})
    stage.finish([work / "garment" / "done.json"])
    with pytest.MonkeyPatch.context() as patched:
        from capture4d.captures.work_folder import WorkFolder, open_work

        patched.setattr(WorkFolder, "posed_body", open_work(styled / "work").posed_body)
        found = fit_style(styled / "model", work, tmp_path / "style.json", StyleFitConfig(count=2))
    assert found.frame_ids == (0, 3)
    assert found.fit.style["length"] == pytest.approx(0.7, abs=0.03)
    assert read_json(tmp_path / "style.json")["source"] == "scans"


def test_a_garment_beyond_what_was_learned_is_exit_3(
    styled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    def grown(garment: StyledGarment, frames: Sequence[SeenFrame], **others: Any) -> StyleFit:
        larger = [replace(each, mesh=each.mesh.with_vertices(each.mesh.vertices * np.float32(1.4))) for each in frames]
        return fit(garment, larger, **others)

    fit = style_of_work.fit_style
    monkeypatch.setattr(style_of_work, "fit_style", grown)
    words = "--output", tmp_path / "style.json", "--frames", "1"
    assert run("fit-style", styled / "model", styled / "work", *words) == 3
    assert "ran into the end of what was learned" in capsys.readouterr().err
    about = read_json(tmp_path / "style.json")
    assert about["verdict"] == "check"
    assert "length" in about["at_limit"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["WORK", "--frames", "77"], "77"),
        (["WORK", "--source", "scans"], "expected the output of 'extract'"),
        (["EMPTY"], "found none"),
    ],
)
def test_what_cannot_be_fitted_is_one_line(
    styled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], said: str
):
    (tmp_path / "empty").mkdir()
    places = {"WORK": styled / "work", "EMPTY": tmp_path / "empty"}
    given = [places.get(word, word) for word in words]
    assert run("fit-style", styled / "model", *given, "--output", tmp_path / "style.json") == 1
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith("capture4d: ")
    assert said in last
    assert not (tmp_path / "style.json").exists()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"style": 3}, "style: expected an object of numbers"),
        ({"style": {"length": "long"}}, "style.length"),
        ({}, "style"),
    ],
)
def test_a_style_file_that_is_none_is_one_line(
    styled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], content: dict, said: str
):
    write_json(tmp_path / "style.json", content)
    words = "--output", tmp_path / "out", "--style", f"@{tmp_path / 'style.json'}"
    assert run("animate", styled / "model", "--poses", styled / "walk.npz", *words) == 1
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert "style.json" in last
    assert said in last
