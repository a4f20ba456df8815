"""Training sets: what they are made of, and that every take wears the same garment."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture4d.captures.capture import read_capture
from capture4d.captures.truth import read_truth_model, read_truth_vertices
from capture4d.files.atomic import read_json
from capture4d.files.records import load_garment, load_poses
from data_synth.config import TRAINING_SETS, RelaxationConfig, SimulationConfig, TrainingSetConfig
from data_synth.training_set import body_takes, run


def test_the_full_set_has_what_learning_needs() -> None:
    config = TRAINING_SETS["tshirt-train"]
    takes = config.takes
    assert sum(take.frames for take in takes.values()) >= 1500
    assert len(takes) >= 10
    assert sum(takes[name].frames for name in config.held_out) >= 300
    assert {take.simulation.fps / take.capture_every for take in takes.values()} == {60.0}
    assert {take.body_shape for take in takes.values()} == {()}
    assert {take.seed for take in takes.values()} == {0}, "another seed is another garment"
    assert all(takes[name].motion.reverse for name in config.reversed)
    assert not set(config.held_out) & set(config.reversed)
    assert len(config.bodies) >= 4
    others = body_takes(config)
    assert all(set(clips) == set(config.held_out) for clips in others.values())
    assert not any(take.scans for clips in others.values() for take in clips.values())


@pytest.fixture(scope="module")
def small() -> TrainingSetConfig:
    config = TRAINING_SETS["tiny-train"]
    takes = {
        name: replace(
            config.takes[name],
            frames=2,
            template_vertices=400,
            simulation=SimulationConfig(
                vertices=400, substeps=6, calm_frames=8, approach_frames=4, rest_frames=1, contact_gap_m=0.012
            ),
            relaxation=RelaxationConfig(vertices=1200, sweeps=4),
        )
        for name in ("twist", "reach-twist")
    }
    return replace(config, takes=takes, held_out=("reach-twist",), reversed=(), bodies={"tall": (1.5, 0.0)})


@pytest.mark.slow
def test_takes_share_a_template_and_other_people_wear_the_same_triangles(
    small: TrainingSetConfig, tmp_path: Path
) -> None:
    digest = run(tmp_path, small, workers=1).digest
    first, second = (load_garment(tmp_path / "takes" / name / "template.npz") for name in small.takes)
    np.testing.assert_array_equal(first.template.vertices, second.template.vertices)
    captured, other = (tmp_path / "takes" / "reach-twist", tmp_path / "bodies" / "tall" / "reach-twist")
    models = [read_truth_model(read_capture(folder, scans=False)) for folder in (captured, other)]
    assert models[0] is not None
    assert models[1] is not None
    np.testing.assert_array_equal(models[0].fine.faces, models[1].fine.faces)
    assert len(models[1].template_faces) == len(first.template.vertices)
    poses = [load_poses(folder / "truth" / "poses.npz") for folder in (captured, other)]
    np.testing.assert_allclose(poses[0].rotations, poses[1].rotations, atol=1e-6)
    heights = [read_truth_vertices(read_capture(folder, scans=False), 2)[:, 1].max() for folder in (captured, other)]
    assert heights[1] > heights[0] + 0.03
    assert not (other / "scans").exists()
    assert read_json(tmp_path / "set.json")["held_out"] == ["reach-twist"]

    # killed while it scanned, it goes on, with the same result
    (tmp_path / "set.json").unlink()
    (captured / "truth" / "000002.npz").unlink()
    (captured / "truth" / "quality.json").unlink()
    assert run(tmp_path, small, workers=1).digest == digest

    # a finished set that has lost a scan makes it again
    scan = captured / "scans" / "000001.ply"
    scan.unlink()
    assert run(tmp_path, small, workers=1).digest == digest
    assert scan.is_file()
