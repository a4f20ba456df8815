"""SMPL's parameters under the names and in the forms that estimators and data sets write are one motion."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.errors import InputError
from capture4d.motions.clips import MotionWords
from capture4d.motions.motion_files import read_motion, write_motion
from capture4d.types import Body, PoseSequence
from tests.unit.capture4d.motions.conftest import joints_of

T = 7
RNG = np.random.default_rng(11)
VECTORS = 0.3 * RNG.standard_normal((T, 24, 3))
VECTORS[:, 0] = np.outer(np.linspace(0, 0.8, T), (0, 1, 0))
UPRIGHT = np.eye(3)
Z_UP = Rotation.from_euler("x", 90, degrees=True).as_matrix()
"""What turns a body that stands along Y so that it stands along Z."""
PLACES = np.array([0.0, 1.2, 0.0]) + np.outer(np.linspace(0, 1, T), (0.6, 0.0, 0.4))
BETAS = np.array([0.5, -0.4, 0.2])


def turned(axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The motion in a world whose axes are turned: rotation vectors (T, 24, 3), translations (T, 3)."""
    vectors = VECTORS.copy()
    vectors[:, 0] = (Rotation.from_matrix(axes) * Rotation.from_rotvec(VECTORS[:, 0])).as_rotvec()
    pelvis = PLACES + PELVIS
    return vectors, pelvis @ axes.T - PELVIS


PELVIS = np.array([0.0, 0.945, 0.0])
"""Of the body of these tests; real ones have theirs near the origin."""
Z, Z_PLACES = turned(Z_UP)


def matrices(vectors: np.ndarray) -> np.ndarray:
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape[:-1], 3, 3)


def flat(vectors: np.ndarray) -> np.ndarray:
    return vectors.reshape(T, -1)


@pytest.fixture
def read(smpl_like: Body, tmp_path: Path):
    def reads(arrays: dict[str, Any], **how) -> PoseSequence:
        np.savez(tmp_path / "clip.npz", **arrays)
        return read_motion(tmp_path / "clip.npz", smpl_like, **how)

    return reads


@pytest.fixture
def expected(smpl_like: Body) -> np.ndarray:
    rotations = np.tile(np.eye(3), (T, 24, 1, 1))
    rotations[:, :22] = matrices(VECTORS[:, :22])
    poses = PoseSequence(
        rotations.astype(np.float32), PLACES.astype(np.float32), BETAS.astype(np.float32),
        np.arange(T, dtype=np.int32), 30.0, smpl_like.joint_names,
    )  # fmt: skip
    return joints_of(smpl_like, poses)


RATE = {"mocap_framerate": 30.0}
FORMS: dict[str, dict[str, Any]] = {
    "amass, smpl-h": {"poses": np.concatenate([flat(Z[:, :22]), np.zeros((T, 90))], 1), "trans": Z_PLACES,
                      "betas": np.pad(BETAS, (0, 13)), "dmpls": np.zeros((T, 8)), "gender": "male", **RATE},
    "amass, smpl-x": {"root_orient": Z[:, 0], "pose_body": flat(Z[:, 1:22]), "pose_hand": np.zeros((T, 90)),
                      "poses": np.concatenate([flat(Z[:, :22]), np.zeros((T, 99))], 1), "trans": Z_PLACES,
                      "betas": BETAS, "mocap_frame_rate": 30.0, "surface_model_type": "smplx"},
    "smpl, 72": {"poses": flat(Z), "trans": Z_PLACES, "betas": BETAS, **RATE},
    "66": {"poses": flat(Z[:, :22]), "trans": Z_PLACES, "betas": BETAS, **RATE},
    "smplx": {"global_orient": Z[:, 0], "body_pose": flat(Z[:, 1:22]), "transl": Z_PLACES, "betas": BETAS, "fps": 30},
    "smplx, 69": {"global_orient": Z[:, 0], "body_pose": flat(Z[:, 1:]), "transl": Z_PLACES, "betas": BETAS,
                  "fps": np.array([30.0])},
    "smplx, a joint an axis": {"global_orient": Z[:, None, 0], "body_pose": Z[:, 1:22], "transl": Z_PLACES,
                               "betas": BETAS[None], "fps": np.array([[30.0]])},
    "smplx, matrices": {"global_orient": matrices(Z[:, None, 0]), "body_pose": matrices(Z[:, 1:]),
                        "transl": Z_PLACES, "betas": np.tile(BETAS, (T, 1)), "fps": "30"},
    "one root matrix a frame": {"global_orient": matrices(Z[:, 0]), "body_pose": matrices(Z[:, 1:22]),
                                "transl": Z_PLACES, "betas": BETAS, "fps": b"30.0"},
    "flat matrices": {"global_orient": matrices(Z[:, 0]).reshape(T, 9), "transl": Z_PLACES, "betas": BETAS,
                      "body_pose": matrices(Z[:, 1:22]).reshape(T, -1), "frame_rate": 30},
    "poses as matrices": {"poses": matrices(Z), "trans": Z_PLACES, "betas": BETAS, "framerate": 30.0},
    "poses a joint an axis": {"poses": Z, "trans": Z_PLACES, "betas": BETAS, **RATE},
    "an axis of one before all": {"poses": flat(Z)[None], "trans": Z_PLACES[None], "betas": BETAS[None], **RATE},
    "an axis of one, smplx": {"global_orient": Z[None, :, 0], "body_pose": flat(Z[:, 1:22])[None],
                              "transl": Z_PLACES[None], "betas": BETAS[None, None], "fps": 30.0},
    "an axis of one, matrices": {"global_orient": matrices(Z[None, :, None, 0]), "body_pose": matrices(Z[None, :, 1:]),
                                 "transl": Z_PLACES[None, :, None], "betas": BETAS, "fps": 30.0},
    "wham": {"poses_root": Z[:, 0], "poses_body": flat(Z[:, 1:]), "trans": Z_PLACES, "betas": BETAS, **RATE},
    "wham, world and camera": {"pose": flat(RNG.random((T, 24, 3))), "trans": RNG.random((T, 3)),
                               "pose_world": flat(Z), "trans_world": Z_PLACES, "betas": BETAS, **RATE},
    "gvhmr, in folders": {"smpl_params_global/global_orient": Z[:, 0], "smpl_params_global/transl": Z_PLACES,
                          "smpl_params_global/body_pose": flat(Z[:, 1:22]), "smpl_params_global/betas": BETAS,
                          "smpl_params_incam/global_orient": RNG.random((T, 3)),
                          "smpl_params_incam/transl": RNG.random((T, 3)),
                          "smpl_params_incam/body_pose": RNG.random((T, 63)),
                          "smpl_params_incam/betas": RNG.random(3), "fps": 30.0},
    "a root of its own beside 69": {"poses": flat(Z[:, 1:]), "global_orient": Z[:, 0], "transl": Z_PLACES,
                                    "betas": BETAS, **RATE},
    "fullpose": {"fullpose": np.concatenate([flat(Z[:, :22]), np.zeros((T, 99))], 1), "transl": Z_PLACES,
                 "betas": BETAS, **RATE},
    "tram": {"pred_rotmat": matrices(Z), "pred_trans": Z_PLACES[:, None], "pred_shape": BETAS, "fps": 30.0},
    "romp": {"smpl_thetas": flat(Z), "cam_trans": Z_PLACES, "smpl_betas": BETAS, "fps": 30.0},
    "aist++": {"smpl_poses": flat(Z), "smpl_trans": 93.0 * Z_PLACES, "smpl_scaling": np.array([93.0]),
               "smpl_betas": BETAS, "fps": 30.0},
    "upper case": {"Poses": flat(Z), "Trans": Z_PLACES, "Betas": BETAS, "FPS": 30},
    "float32": {"poses": flat(Z).astype(np.float32), "trans": Z_PLACES.astype(np.float32), "betas": BETAS,
                "mocap_framerate": np.float32(30)},
}  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_every_form_is_the_same_motion(form: str, read, smpl_like: Body, expected: np.ndarray) -> None:
    poses = read(FORMS[form])
    assert poses.fps == 30.0
    assert np.linalg.norm(joints_of(smpl_like, poses) - expected, axis=2).max() < 1e-4


@pytest.mark.parametrize("axis", ["x", "y", "z", "-x", "-y", "-z"])
def test_the_axis_that_is_up_is_found_or_said(axis: str, read, smpl_like: Body, expected: np.ndarray) -> None:
    """Up to the heading, which such a file does not fix."""
    onto = {"y": UPRIGHT, "z": Z_UP, "-z": Z_UP.T, "-y": Z_UP @ Z_UP,
            "x": Rotation.from_euler("z", -90, degrees=True).as_matrix(),
            "-x": Rotation.from_euler("z", 90, degrees=True).as_matrix()}[axis]  # fmt: skip
    vectors, places = turned(onto)
    arrays = {"poses": flat(vectors), "trans": places, "betas": BETAS, **RATE}
    notes: list[str] = []
    for words in (MotionWords(), MotionWords(up=axis)):  # type: ignore[arg-type]
        found = joints_of(smpl_like, read(arrays, words=words, say=notes.append))
        np.testing.assert_allclose(found[..., 1], expected[..., 1], atol=1e-4)
        here, there = (np.linalg.norm(np.diff(each[..., [0, 2]], axis=0), axis=2) for each in (found, expected))
        np.testing.assert_allclose(here, there, atol=1e-4)
    assert notes[0].startswith(f"{axis.upper()} up")
    assert ("found from the trunk" in notes[0]) == (axis != "z")


def test_who_lies_in_a_world_of_z_up_is_left_lying(read, smpl_like: Body) -> None:
    down = Rotation.from_euler("x", -85, degrees=True) * Rotation.from_matrix(Z_UP)
    vectors = VECTORS.copy()
    vectors[:, 0] = down.as_rotvec()
    places = np.tile([0.3, 0.2, 0.12], (T, 1))
    notes: list[str] = []
    joints = joints_of(smpl_like, read({"poses": flat(vectors), "trans": places, **RATE}, say=notes.append))
    trunk = joints[:, 12] - joints[:, 0]
    assert np.abs(trunk[:, 1]).max() < 0.7 * np.linalg.norm(trunk, axis=1).min()
    assert "--up says which it is" in notes[0]


def test_what_we_wrote_ourselves_is_z_up_whatever_it_shows(light_body: Body, tmp_path: Path) -> None:
    rotations = np.tile(np.eye(3, dtype=np.float32), (3, len(light_body.joint_names), 1, 1))
    rotations[:, 0] = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    poses = PoseSequence(rotations, np.zeros((3, 3), np.float32), np.zeros(2, np.float32),
                         np.arange(3, dtype=np.int32), 60.0, light_body.joint_names)  # fmt: skip
    write_motion(tmp_path / "clip.npz", light_body, poses, amass=True)
    back = joints_of(light_body, read_motion(tmp_path / "clip.npz", light_body))
    np.testing.assert_allclose(back, joints_of(light_body, poses), atol=1e-4)


def test_a_body_that_is_turned_about_the_origin(read, smpl_like: Body) -> None:
    """EasyMocap: x = Rh (posed body) + Th, against its own equation."""
    turn, move = Rotation.from_rotvec(RNG.standard_normal((T, 3))), RNG.standard_normal((T, 3))
    still = VECTORS.copy()
    still[:, 0] = 0
    arrays = {"poses": flat(still), "Rh": turn.as_rotvec(), "Th": move, "shapes": BETAS[None], "fps": 50}
    joints = joints_of(smpl_like, read(arrays, words=MotionWords(up="y")))
    alone = joints_of(smpl_like, read({"poses": flat(still), "trans": np.zeros((T, 3)), "betas": BETAS, "fps": 50},
                                      words=MotionWords(up="y")))  # fmt: skip
    shaped_root = alone[0, 0] - smpl_like.joints[0]  # what the shape adds, which their origin knows nothing of
    expected = np.einsum("tab,tjb->tja", turn.as_matrix(), alone - shaped_root) + move[:, None]
    np.testing.assert_allclose(joints - shaped_root, expected, atol=1e-4)


def test_a_rate_may_be_told(read, smpl_like: Body) -> None:
    arrays = {"poses": flat(Z), "trans": Z_PLACES}
    with pytest.raises(InputError, match=r"clip\.npz: expected a frame rate as mocap_framerate .* --fps tells it"):
        read(arrays)
    poses = read(arrays, fps=25.0)
    assert poses.fps == 25.0
    assert len(poses.frame_ids) == T, "the file's own rate, nothing is resampled"
    assert len(read({**arrays, **RATE}, fps=60.0).frame_ids) == 2 * T - 1


def test_what_is_not_there_is_told(read) -> None:
    notes: list[str] = []
    poses = read({"poses": flat(Z), "betas": BETAS + np.arange(T)[:, None], **RATE}, say=notes.append)
    assert notes[0] == "no translations are there: the body stays in its place"
    assert "their mean is taken" in notes[1]
    np.testing.assert_allclose(poses.shape, BETAS + 3, atol=1e-6)


def with_row(array: np.ndarray, row: int, value: float) -> np.ndarray:
    array = array.copy()
    array[row] = value
    return array


MIRROR = matrices(Z) * np.array([-1.0, 1, 1])
SHEAR = matrices(Z) + np.triu(np.full((3, 3), 0.2), 1)
GOOD = {"poses": flat(Z), "trans": Z_PLACES, **RATE}
FINITE, FORM = "expected finite numbers, found NaN or infinity", "expected rotation vectors or matrices of 22 or more"
RATES = "'mocap_framerate': expected a frame rate from 0.1 to 10000, found"
WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "poses of NaN": ({"poses": with_row(flat(Z), 3, np.nan)}, f"'poses': {FINITE} in frame 3 of 7"),
    "translations of infinity": ({"trans": with_row(Z_PLACES, 5, np.inf)}, f"'trans': {FINITE} in frame 5 of 7"),
    "a shape of NaN": ({"betas": with_row(BETAS, 0, np.nan)}, "'betas': expected finite numbers"),
    "no frames": ({"poses": np.zeros((0, 72)), "trans": np.zeros((0, 3))}, "'poses': expected at least one frame"),
    "too few joints": ({"poses": np.zeros((T, 30))}, f"'poses': {FORM} joints"),
    "the root is lacking": ({"poses": np.zeros((T, 63))}, f"'poses': {FORM}"),
    "six numbers a joint": ({"poses": np.zeros((T, 24, 6))}, "perhaps 6 numbers a joint"),
    "quaternions": ({"poses": np.zeros((T, 24, 4))}, "perhaps quaternions"),
    "six, flat": ({"poses": np.zeros((T, 144))}, f"'poses': {FORM}"),
    "a number": ({"poses": np.float64(3)}, "'poses': expected rotation vectors"),
    "vectors of another number": ({"poses": np.zeros((24, 4, 3))}, f"'poses': {FORM}"),
    "text": ({"poses": np.array(["a"])}, "'poses': expected numbers, found <U1"),
    "mirrors": ({"poses": MIRROR}, "found one that is none in frame 0 of 7, joint 0"),
    "shears": ({"poses": SHEAR}, "'poses': expected rotation matrices, found one that is none in frame 0 of 7"),
    "degrees of who stands": ({"poses": np.where(np.arange(66) == 30, 20.0, flat(Z)[:, :66])}, "in radians"),
    "degrees": ({"poses": np.degrees(flat(Z)) + 90}, "'poses': expected rotation vectors in radians"),
    "fewer translations": ({"trans": Z_PLACES[:4]}, "translations (7, 3), found an array of shape (4, 3)"),
    "flat translations": ({"trans": Z_PLACES[:, :2]}, "'trans': expected translations (7, 3)"),
    "a rate of 0": ({"mocap_framerate": 0}, f"{RATES} 0"),
    "a rate of NaN": ({"mocap_framerate": np.nan}, f"{RATES} nan"),
    "a negative rate": ({"mocap_framerate": -120.0}, f"{RATES} -120"),
    "a rate of 1e30": ({"mocap_framerate": 1e30}, f"{RATES} 1e+30"),
    "a scaling of 0": ({"smpl_scaling": 0.0}, "'smpl_scaling': expected a positive number, found 0"),
    "two rates": ({"mocap_framerate": np.array([30.0, 60.0])}, f"{RATES} float64"),
    "no rate": ({"mocap_framerate": np.zeros(0)}, "'mocap_framerate': expected a frame rate"),
    "a rate in words": ({"mocap_framerate": "fast"}, "'mocap_framerate': expected a frame rate"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_what_is_no_motion_is_one_line_of_the_file(name: str, read, tmp_path: Path) -> None:
    change, said = WRONG[name]
    with pytest.raises(InputError) as caught:
        read({**GOOD, **change})
    assert said in caught.value.reason
    assert caught.value.where == str(tmp_path / "clip.npz")


@pytest.mark.parametrize(("arrays", "said"), [
    ({"body_pose": flat(Z[:, 1:]), **RATE}, "expected an array 'root_orient' or 'global_orient' beside 'body_pose'"),
    ({"global_orient": Z[:, 0], **RATE}, "expected an array 'pose_body' or 'body_pose' beside 'global_orient'"),
    ({"global_orient": Z[:4, 0], "body_pose": flat(Z[:, 1:]), **RATE},
     "'global_orient': expected rotation vectors or matrices of 1 joints in 7 frames"),
    ({"poses": np.array([{"a": 1}], object), **RATE}, "damaged array 'poses'"),
    ({"anything": np.zeros(3)}, "expected an array 'rotations'"),
])  # fmt: skip
def test_what_lacks_a_part_is_one_line(arrays: dict[str, Any], said: str, read) -> None:
    with pytest.raises(InputError) as caught:
        read(arrays)
    assert said in caught.value.reason
