"""The synthetic take as a stage: the same on any number of workers, and whole again after a loss."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture4d.errors import InputError
from capture4d.files.atomic import read_json, write_npz
from data_synth.config import PRESETS, MotionConfig, RelaxationConfig, SimulationConfig, SynthConfig
from data_synth.scanner.config import FusionConfig, RigConfig, ScannerConfig
from data_synth.stage import is_whole, open_take, run, simulated_frames, simulation_jobs

SMALLEST = replace(
    PRESETS["tiny"],
    frames=2,
    capture_every=1,
    template_vertices=400,
    simulation=SimulationConfig(
        vertices=400, substeps=6, calm_frames=8, approach_frames=4, rest_frames=1, contact_gap_m=0.012
    ),
    relaxation=RelaxationConfig(vertices=1200, sweeps=4),
    scanner=ScannerConfig(
        rig=RigConfig(cameras=8, image_size=120),
        fusion=FusionConfig(garment_voxel_m=0.012, body_voxel_m=0.02, min_component_faces=20),
    ),
)


def files(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
def test_the_take_does_not_depend_on_workers_and_what_is_lost_is_made_again(tmp_path: Path) -> None:
    alone, shared = tmp_path / "alone", tmp_path / "shared"
    digest = run(alone, SMALLEST, workers=1).digest
    assert run(shared, SMALLEST, workers=2).digest == digest
    whole = files(alone)

    (alone / "notes.txt").write_text("a note of the lab's is no part of the take")
    (alone / "scans" / "000002.ply").unlink()
    cut = alone / "scans" / "000001.ply"
    cut.write_bytes(cut.read_bytes()[:-1000])
    (alone / "rig.json").unlink()
    assert run(alone, SMALLEST, workers=1).digest == digest
    assert files(alone) == whole | {"notes.txt"}
    assert read_json(alone / "stage.json")["digest"] == digest


def test_a_take_is_whole_only_with_all_its_files(tmp_path: Path) -> None:
    stage = open_take(tmp_path / "take", SMALLEST)
    assert not is_whole(stage, SMALLEST)


def test_what_an_interrupted_simulation_left_is_not_counted_as_done(tmp_path: Path) -> None:
    stage = open_take(tmp_path / "take", SMALLEST)
    write_npz(stage.path / "cloth" / "000001.npz", vertices=np.zeros((3, 3)))
    assert simulated_frames(stage) == 1
    assert len(simulation_jobs(stage, SMALLEST)) == 1
    assert simulated_frames(stage) == 0


def test_a_motion_file_is_part_of_what_a_take_is_made_of(tmp_path: Path) -> None:
    """Another motion under the same name is not the take that lies there."""
    motion = tmp_path / "walk.bvh"
    motion.write_text("HIERARCHY of yesterday")
    config = replace(SMALLEST, motion=MotionConfig(bvh=str(motion)))
    open_take(tmp_path / "take", config)
    open_take(tmp_path / "take", config)
    motion.write_text("HIERARCHY of today")
    with pytest.raises(InputError, match=r"made from other inputs \(bvh"):
        open_take(tmp_path / "take", config)
    open_take(tmp_path / "take", config, overwrite=True)


def test_without_a_motion_file_a_take_is_made_of_nothing(tmp_path: Path) -> None:
    open_take(tmp_path / "take", SynthConfig())
    assert read_json(tmp_path / "take" / "stage.json")["upstream"] == {}
