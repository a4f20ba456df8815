"""A garment model in Python: the same vertices as `animate` writes, and one line for what is wrong."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture4d.body.skinning import pose_frame
from capture4d.captures.animations.config import RemovalConfig
from capture4d.captures.work_folder import load_registration, open_work
from capture4d.errors import InputError
from capture4d.files.records import save_poses
from capture4d.geometry.ray_casting import TriangleScene
from capture4d.types import PoseSequence
from retarget.animation.garment_model import GarmentModel, load_garment_model
from retarget.animation.stage import Wearer, run
from retarget.config import AnimateConfig


@pytest.fixture(scope="module")
def garment_model(learned: Path) -> GarmentModel:
    return load_garment_model(learned)


@pytest.fixture
def poses(motion) -> PoseSequence:
    """More frames than are computed at once."""
    return motion(21, 5)


@pytest.mark.parametrize("beta", [None, (3.0,), (-1.0, 2.0)])
@pytest.mark.parametrize("removal", [True, False])
def test_vertices_are_those_that_animate_writes(
    garment_model: GarmentModel, poses: PoseSequence, tmp_path: Path, beta: tuple[float, ...] | None, removal: bool
) -> None:
    save_poses(tmp_path / "poses.npz", poses)
    config = AnimateConfig(removal=RemovalConfig(enabled=removal))
    run(garment_model.folder, tmp_path / "poses.npz", tmp_path / "out", config, wearer=Wearer(beta=beta))
    wanted = load_registration(tmp_path / "out" / "registration").vertices
    found = garment_model.vertices(poses, beta, remove_intersections=removal)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, wanted)


def test_processes_write_what_one_writes(garment_model: GarmentModel, poses: PoseSequence, tmp_path: Path) -> None:
    save_poses(tmp_path / "poses.npz", poses)
    results = [
        run(garment_model.folder, tmp_path / "poses.npz", tmp_path / str(workers), AnimateConfig(), workers=workers)
        for workers in (1, 2)
    ]
    assert results[0].digest == results[1].digest


def test_somebody_else_wears_it_outside_the_body(garment_model: GarmentModel, poses: PoseSequence) -> None:
    thick = [4.0]
    person = garment_model.person(thick)

    def inside(vertices: np.ndarray) -> int:
        count = 0
        for row, placed in enumerate(vertices):
            body = pose_frame(person, poses, row).vertices()
            nearest = TriangleScene((body, person.body.template.faces)).nearest(placed)
            count += int((((placed - nearest.points) * nearest.normals).sum(axis=1) < -2e-4).sum())
        return count

    slim = garment_model.vertices(poses, remove_intersections=False)  # as it was captured, on too thick a limb
    assert inside(slim) > 100
    assert inside(garment_model.vertices(poses, thick)) < 10
    assert not np.allclose(garment_model.vertices(poses, thick), garment_model.vertices(poses))


def test_the_shape_in_the_poses_is_not_whom_they_are_worn_by(garment_model: GarmentModel, poses: PoseSequence) -> None:
    other = replace(poses, shape=np.float32([2, 2]))
    np.testing.assert_array_equal(garment_model.vertices(other), garment_model.vertices(poses))


def test_the_captured_motion_gives_back_the_capture(garment_model: GarmentModel, works: list[Path]) -> None:
    registered = load_registration(works[0] / "registration")
    _, poses = open_work(works[0]).require_posed_body()
    found = garment_model.vertices(poses, remove_intersections=False)
    good = np.delete(np.arange(16), 4)
    apart = np.linalg.norm(found[good] - registered.vertices[good], axis=-1)
    assert np.median(apart) < 0.008  # what stretches as no cloth does is drawn in


@pytest.mark.parametrize(
    ("change", "beta", "said"),
    [
        ({"frame_ids": np.arange(21, 0, -1, dtype=np.int32)}, None, "pose: expected frames with ascending numbers"),
        ({"joint_names": ("hip", "knee", "foot")}, None, "pose: expected the 3 joints of the model, found 3"),
        ({"fps": 30.0}, None, "expected 60 frames a second, as the model, found 30"),
        ({}, [1.0, 2.0, 3.0], "beta: expected at most 2 coefficients, found 3"),
        ({}, [float("nan")], "beta: expected finite numbers"),
    ],
)
def test_what_is_wrong_is_one_line(
    garment_model: GarmentModel, poses: PoseSequence, change: dict, beta: list[float] | None, said: str
) -> None:
    with pytest.raises(InputError, match=said) as error:
        garment_model.vertices(replace(poses, **change), beta)
    assert "\n" not in str(error.value)
