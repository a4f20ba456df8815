"""A garment with styles from the command line: animated like any other, and what is wrong in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from capture4d.captures.work_folder import load_records, load_registration, open_work
from capture4d.cli.main import main
from capture4d.files.atomic import read_json
from capture4d.files.records import save_body, save_poses
from retarget.mixture.config import NetworkConfig, StylesConfig
from retarget.mixture.model_files import load_styled_garment
from retarget.mixture.stage import run as fit_styles
from tests.unit.retarget.mixture.conftest import made_style_set, motion, write_style_set


@pytest.fixture(scope="module")
def styled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model, and a motion beside it."""
    folder = tmp_path_factory.mktemp("styled")
    write_style_set(folder / "set", made_style_set())
    config = StylesConfig(members=1, network=NetworkConfig(hidden=8, epochs=5))
    fit_styles(folder / "set", folder / "model", config)
    save_poses(folder / "walk.npz", motion([0.05, 0.3, 0.62, 2.4], np.array([[0, 0.1 * k, 0] for k in range(4)])))
    return folder


def animate(styled: Path, output: Path, *more: str | Path) -> int:
    words = "animate", styled / "model", "--poses", styled / "walk.npz", "--output", output, "--workers", "1", *more
    with pytest.raises(SystemExit) as exit_:
        main([str(word) for word in words])
    return int(exit_.value.code or 0)


def test_an_animation_is_what_the_garment_says(styled: Path, tmp_path: Path):
    assert animate(styled, tmp_path / "a", "--style", "length=0.7", "--beta", "0.5") == 0
    found, garment = load_registration(tmp_path / "a" / "registration"), load_styled_garment(styled / "model")
    poses = motion([0.05, 0.3, 0.62, 2.4], np.array([[0, 0.1 * k, 0] for k in range(4)]))
    np.testing.assert_array_equal(found.vertices, garment.vertices(poses, [0.5], {"length": 0.7}))
    worn = garment.worn([0.5], {"length": 0.7})
    np.testing.assert_allclose(found.garment.template.vertices, worn.in_a_pose, atol=1e-6)
    assert np.isnan(found.residual_m).all()
    body, moved = open_work(tmp_path / "a").require_posed_body()
    assert body.joint_names == moved.joint_names
    np.testing.assert_allclose(moved.shape, [0.5])
    records = load_records(tmp_path / "a" / "registration")
    assert [record["frame_id"] for record in records] == [0, 1, 2, 3]
    assert max(record["pose_distance_deg"] for record in records[:3]) < 5
    assert "from every pose that was learned" in "; ".join(records[3]["reasons"])  # bent as nobody taught

    digest = read_json(tmp_path / "a" / "registration" / "stage.json")["digest"]
    (tmp_path / "a" / "registration" / "frames" / "000002.npz").unlink()
    assert animate(styled, tmp_path / "a", "--style", "length=0.7", "--beta", "0.5") == 0
    assert read_json(tmp_path / "a" / "registration" / "stage.json")["digest"] == digest


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--style", "length"], "--style: expected NAME=VALUE, numbers or @FILE, found 'length'"),
        (["--style", "length=long"], "--style: expected NAME=VALUE, numbers or @FILE, found 'length=long'"),
        (["--style", "length=0.5", "wide"], "--style: expected NAME=VALUE, found 'wide'"),
        (["--style", "0.5,0.7"], "style: expected at most 1 numbers, length; found 2"),
        (["--style", "@none.json", "length=1"], "--style: expected one file, or numbers"),
        (["--style", "@none.json"], "none.json"),
        (["--style", "width=1"], "style: expected length, found 'width'"),
        (["--style", "length=3"], "style length: expected 0.4 to 0.8"),
        (["--beta", "4"], "beta 1: expected -1 to 1"),
        (["--regressor", "linear"], "--regressor: expected none"),
    ],
)
def test_what_is_wrong_is_one_line(
    styled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], said: str
):
    assert animate(styled, tmp_path / "out", *more) == 1
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith("capture4d: ")
    assert said in last
    assert not (tmp_path / "out" / "registration").exists()


def test_another_body_is_refused(styled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    save_body(tmp_path / "body.npz", load_styled_garment(styled / "model").body)
    assert animate(styled, tmp_path / "out", "--body", tmp_path / "body.npz") == 1
    assert "--body: expected none" in capsys.readouterr().err
