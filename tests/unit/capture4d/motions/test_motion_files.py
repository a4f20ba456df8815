"""Motion files: what goes out comes in again, and other skeletons move like their source."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.body.anny import load_anny
from capture4d.body.skinning import pose_frame, with_shape
from capture4d.errors import InputError
from capture4d.files.records import save_poses
from capture4d.motions.bvh import Bvh, format_bvh, moved_by_root
from capture4d.motions.clips import understood
from capture4d.motions.motion_files import read_motion, resample, write_motion
from capture4d.motions.retargeting import retarget
from capture4d.types import Body, PoseSequence
from tests.bvh_files import TOOLS, text, walk
from tests.command_line import fails, run


def random_poses(body: Body, seed: int, frames: int = 5) -> PoseSequence:
    rng = np.random.default_rng(seed)
    joints = len(body.joint_names)
    rotations = Rotation.from_rotvec(0.6 * rng.standard_normal((frames * joints, 3))).as_matrix()
    return PoseSequence(
        rotations.reshape(frames, joints, 3, 3).astype(np.float32),
        rng.standard_normal((frames, 3)).astype(np.float32),
        rng.standard_normal(4).astype(np.float32),
        np.arange(frames, dtype=np.int32),
        60.0,
        body.joint_names,
    )


def centres(body: Body, poses: PoseSequence) -> np.ndarray:
    """World joint positions (T, J, 3)."""
    shaped = with_shape(body, poses.shape)
    transforms = np.stack([pose_frame(shaped, poses, t).transforms for t in range(len(poses.frame_ids))])
    return np.einsum("tjab,jb->tja", transforms[:, :, :3, :3], shaped.joints) + transforms[:, :, :3, 3]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_bvh_round_trip_keeps_joint_positions_and_shape(tmp_path: Path, seed: int) -> None:
    body = load_anny()
    poses = random_poses(body, seed)
    write_motion(tmp_path / "clip.bvh", body, poses)
    back = read_motion(tmp_path / "clip.bvh", body)
    assert back.fps == 60.0
    np.testing.assert_allclose(centres(body, back), centres(body, poses), atol=1e-4)
    np.testing.assert_allclose(back.shape[:4], poses.shape, atol=1e-3)


def test_own_npz_round_trip_is_exact(tmp_path: Path) -> None:
    body = load_anny()
    poses = random_poses(body, 3)
    write_motion(tmp_path / "poses.npz", body, poses)
    back = read_motion(tmp_path / "poses.npz", body)
    np.testing.assert_array_equal(back.rotations, poses.rotations)


def test_amass_round_trip_on_a_body_of_its_family(smpl_like: Body, tmp_path: Path) -> None:
    poses = random_poses(smpl_like, 4)
    poses.rotations[:, 22:] = np.eye(3)
    write_motion(tmp_path / "clip.npz", smpl_like, poses, amass=True)
    with np.load(tmp_path / "clip.npz") as arrays:
        assert arrays["poses"].shape == (5, 156)
        assert float(arrays["mocap_framerate"]) == 60.0
    back = read_motion(tmp_path / "clip.npz", smpl_like)
    np.testing.assert_allclose(centres(smpl_like, back), centres(smpl_like, poses), atol=1e-5)


def test_a_hand_of_a_body_of_its_family_survives_amass(smpl_like: Body, tmp_path: Path) -> None:
    poses = random_poses(smpl_like, 8)
    write_motion(tmp_path / "clip.npz", smpl_like, poses, amass=True)
    back = read_motion(tmp_path / "clip.npz", smpl_like)
    np.testing.assert_allclose(back.rotations, poses.rotations, atol=1e-5)


def cmu_clip(spine: tuple[str, ...], arm: tuple[str, ...], leg: tuple[str, ...], seed: int) -> Bvh:
    """A random clip of the CMU database's skeleton in centimetres, T-pose at rest, under one of its namings."""
    rng = np.random.default_rng(seed)
    names, parents, offsets = ["Hips"], [-1], [(0.0, 0.0, 0.0)]

    def grow(parent: int, chain: tuple[str, ...], steps: Sequence[tuple[float, float, float]]) -> int:
        for name, step in zip(chain, steps, strict=True):
            names.append(name)
            parents.append(parent)
            offsets.append(step)
            parent = len(names) - 1
        return parent

    grow(0, spine, [(0, 5, 0), (0, 11, 0), (0, 11, 0), (0, 13, 0), (0, 6, 0), (0, 6, 0)])
    for side, x in (("Left", 1.0), ("Right", -1.0)):
        words = tuple(side + word for word in leg)
        grow(0, words, [(9 * x, -4, 0), (0, -42, 0), (0, -41, 0)])
        words = tuple(side + word for word in arm)
        grow(3, words, [(4 * x, 9, 0), (14 * x, 0, 0), (28 * x, 0, 0), (24 * x, 0, 0)])
    frames = 40
    knots = 0.35 * rng.standard_normal((5, len(names), 3))
    at = np.linspace(0, 4, frames)
    vectors = np.stack([np.interp(at, range(5), knots[:, j, a]) for j in range(len(names)) for a in range(3)], axis=1)
    places = np.array([0.0, 95.0, 0.0]) + np.outer(at, rng.normal(0, 20, 3) * (1, 0, 1))
    return Bvh(
        Path("generated.bvh"), tuple(names), np.array(parents), np.array(offsets, float),
        Rotation.from_rotvec(vectors.reshape(-1, 3)), moved_by_root(np.array(offsets, float), places), 1 / 120,
    )  # fmt: skip


NAMINGS = (
    (("LowerBack", "Spine", "Spine1", "Neck", "Neck1", "Head"), ("Shoulder", "Arm", "ForeArm", "Hand"),
     ("UpLeg", "Leg", "Foot")),
    (("lowerback", "Chest", "Chest2", "lowerneck", "Neck", "Head"), ("Collar", "Shoulder", "Elbow", "Wrist"),
     ("Hip", "Knee", "Ankle")),
)  # fmt: skip


@pytest.mark.parametrize("naming", NAMINGS, ids=["motionbuilder", "daz"])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_cmu_clip_drives_the_body_and_goes_out_in_every_format(tmp_path: Path, naming: tuple, seed: int) -> None:
    body, source = load_anny(), cmu_clip(*naming, seed)
    (tmp_path / "in.bvh").write_text(format_bvh(source, np.ones((len(source.parents), 3))))
    poses = read_motion(tmp_path / "in.bvh", body, fps=60)
    places = centres(body, poses)
    assert len(places) == 20

    # every limb points where the clip's does
    world = source.world_rotations()[::2]
    for name, end, theirs in (("upperarm01.L", "lowerarm01.L", 1), ("lowerarm01.R", "wrist.R", 2)):
        ours = places[:, body.joint_names.index(end)] - places[:, body.joint_names.index(name)]
        joint = source.joint_names.index(("Left" if name.endswith("L") else "Right") + naming[1][theirs])
        along = world[:, joint] @ [1.0 if name.endswith("L") else -1.0, 0.0, 0.0]
        np.testing.assert_allclose(ours / np.linalg.norm(ours, axis=1, keepdims=True), along, atol=1e-3)

    for file, amass in (("out.bvh", False), ("out.npz", False), ("amass.npz", True)):
        write_motion(tmp_path / file, body, poses, amass=amass)
        back = centres(body, read_motion(tmp_path / file, body))
        assert np.linalg.norm(back - places, axis=2).max() < 1e-3

    with np.load(tmp_path / "amass.npz") as arrays:
        np.savez(tmp_path / "plain.npz", **{name: arrays[name] for name in ("poses", "trans", "mocap_framerate")})
    plain = centres(body, read_motion(tmp_path / "plain.npz", body))
    joints = [body.joint_names.index(name) for name in ("head", "wrist.L", "wrist.R", "foot.L", "foot.R")]
    apart = plain - places - (plain - places)[:, :1]
    assert np.linalg.norm(apart[:, joints], axis=2).max() < 0.03, "readers of AMASS's own arrays see the pose"


def test_hands_of_a_t_pose_continue_the_arms() -> None:
    source = cmu_clip(*NAMINGS[0], seed=0)
    still = replace(source, rotations=Rotation.identity(40 * len(source.parents)))
    body = load_anny()
    poses = retarget(with_shape(body, np.zeros(0, np.float32)), understood(still)[0], 60.0)
    wrist = poses.rotations[0, body.joint_names.index("wrist.L")]
    assert np.degrees(Rotation.from_matrix(wrist).magnitude()) < 1.0


def test_amass_is_z_up(smpl_like: Body, tmp_path: Path) -> None:
    """SMPL stands up in AMASS by a quarter turn about x; that is our rest pose."""
    vectors = np.zeros((2, 156))
    vectors[:, 0] = np.pi / 2
    root = smpl_like.joints[0].astype(float)
    trans = np.tile([0.0, 0.0, root[1]] - root, (2, 1))
    for rate in ("mocap_framerate", "mocap_frame_rate"):
        np.savez(tmp_path / "clip.npz", poses=vectors, trans=trans, betas=np.zeros(16), **{rate: 120.0})
        poses = read_motion(tmp_path / "clip.npz", smpl_like)
        assert poses.fps == 120.0
        np.testing.assert_allclose(poses.rotations[0], np.broadcast_to(np.eye(3), (24, 3, 3)), atol=1e-6)
        np.testing.assert_allclose(poses.translations[0], 0.0, atol=1e-6)


def test_amass_on_another_body_points_its_limbs_the_same_way(tmp_path: Path) -> None:
    body = load_anny()
    rng = np.random.default_rng(5)
    vectors = np.zeros((3, 52, 3))
    vectors[:, 0] = (np.pi / 2, 0, 0)
    vectors[:, 16:19] = 0.5 * rng.standard_normal((3, 3, 3))
    np.savez(tmp_path / "clip.npz", poses=vectors.reshape(3, -1), trans=np.zeros((3, 3)), mocap_framerate=60.0)
    poses = read_motion(tmp_path / "clip.npz", body)
    places = centres(body, poses)
    index = body.joint_names.index
    arm = places[:, index("lowerarm01.L")] - places[:, index("upperarm01.L")]
    turned = Rotation.from_rotvec(vectors[:, 16]).apply([1.0, 0.0, 0.0])
    np.testing.assert_allclose(arm / np.linalg.norm(arm, axis=1, keepdims=True), turned, atol=1e-5)

    write_motion(tmp_path / "again.npz", body, poses, amass=True)
    np.testing.assert_allclose(read_motion(tmp_path / "again.npz", body).rotations, poses.rotations, atol=1e-5)


def test_resampling_at_the_same_rate_changes_nothing() -> None:
    poses = random_poses(load_anny(), 6)
    np.testing.assert_allclose(resample(poses, 60.0).rotations, poses.rotations, atol=1e-6)
    doubled = resample(poses, 120.0)
    assert len(doubled.frame_ids) == 9
    np.testing.assert_allclose(doubled.rotations[::2], poses.rotations, atol=1e-6)


def test_resampling_is_told_and_nothing_else_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, out = tmp_path / "walk.npz", tmp_path / "out.npz"
    save_poses(source, random_poses(load_anny(), 6, frames=7))
    line = f"capture4d: {source}: 60 frames a second, resampled to 20: 7 frames became 3\n"
    for fps, said in ((20.0, line), (60.0, ""), (60.0 * (1 + 1e-5), "")):
        assert run("convert-poses", source, out, "--fps", fps, "--overwrite") == 0
        assert capsys.readouterr().err == said
    assert run("convert-poses", source, out, "--overwrite") == 0
    assert capsys.readouterr().err == ""
    notes: list[str] = []
    assert len(read_motion(source, load_anny(), fps=30.0, say=notes.append).frame_ids) == 4
    assert notes == ["60 frames a second, resampled to 30: 7 frames became 4"]


@pytest.mark.parametrize(("own", "fps"), [(60.0, 1e12), (0.01, 1e5), (60.0, np.inf)])
def test_a_rate_that_is_none_asks_for_no_memory(own: float, fps: float, tmp_path: Path) -> None:
    save_poses(tmp_path / "poses.npz", replace(random_poses(load_anny(), 6), fps=own))
    with pytest.raises(InputError, match=r"poses\.npz: expected at most 100000 frames"):
        read_motion(tmp_path / "poses.npz", load_anny(), fps=fps)


def test_what_is_no_motion_is_named(tmp_path: Path) -> None:
    body = load_anny()
    with pytest.raises(InputError, match="no such motion file"):
        read_motion(tmp_path / "none.bvh", body)
    (tmp_path / "notes.txt").write_text("")
    with pytest.raises(InputError, match=r"expected a motion file \.npz or \.bvh"):
        read_motion(tmp_path / "notes.txt", body)
    np.savez(tmp_path / "clip.npz", poses=np.zeros((2, 66)), trans=np.zeros((2, 3)))
    with pytest.raises(
        InputError, match="expected a frame rate as mocap_framerate or mocap_frame_rate or fps, found none"
    ):
        read_motion(tmp_path / "clip.npz", body)
    np.savez(tmp_path / "clip.npz", poses=np.zeros((2, 30)), trans=np.zeros((2, 3)))
    with pytest.raises(InputError, match="'poses': expected rotation vectors or matrices of 22 or more joints"):
        read_motion(tmp_path / "clip.npz", body)
    write_motion(
        tmp_path / "own.npz",
        body,
        replace(random_poses(body, 7), joint_names=tuple(f"j{joint}" for joint in range(36))),
    )
    with pytest.raises(InputError, match="expected the body's 36 joints"):
        read_motion(tmp_path / "own.npz", body)


def test_a_body_without_the_joints_that_a_motion_drives_is_named() -> None:
    body, source = load_anny(), cmu_clip(*NAMINGS[0], 0)
    for missing in ("upperleg01.L", "lowerarm01.R", "foot.L"):
        names = tuple(name.replace(missing, "other") for name in body.joint_names)
        shaped = with_shape(replace(body, joint_names=names), np.zeros(0, np.float32))
        with pytest.raises(InputError, match=f"found none called {missing}"):
            retarget(shaped, understood(source)[0], 60.0)


def test_poses_have_a_shape_of_finite_numbers() -> None:
    poses = random_poses(load_anny(), 0)
    with pytest.raises(InputError, match=r"PoseSequence\.shape: expected finite numbers"):
        replace(poses, shape=np.array([np.nan], np.float32))


def test_rotations_that_are_none_are_named(tmp_path: Path) -> None:
    body = load_anny()
    poses = random_poses(body, 2)
    for wrong in (np.zeros((3, 3)), np.diag([1, 1, -1]), 2 * np.eye(3)):
        save_poses(tmp_path / "poses.npz", poses)
        with np.load(tmp_path / "poses.npz") as whole:
            arrays = dict(whole)
        arrays["rotations"][3, 6] = wrong
        np.savez(tmp_path / "poses.npz", **arrays)
        with pytest.raises(
            InputError, match=r"poses\.npz: PoseSequence.rotations: expected rotations, .* row 3, joint 6"
        ):
            read_motion(tmp_path / "poses.npz", body)


# --- through the command


@pytest.fixture
def strange(tmp_path: Path) -> Path:
    """Z up, and joints that nobody would know."""
    axes = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    base = walk()
    (tmp_path / "in.bvh").write_text(text(base.called(lambda part: f"q{base.names.index(part)}").in_axes(axes)))
    given = {part: f"q{base.names.index(part)}" for part in base.names if part not in ("neck1", "neck2", "spine1")}
    ours = {
        "spine2": "spine03",
        "spine3": "spine01",
        "left_hip": "upperleg01.L",
        "right_ankle": "foot.R",
        "pelvis": "root",
    }
    given = {ours.get(part, part): name for part, name in given.items()} | {"spine05": f"q{base.names.index('spine1')}"}
    (tmp_path / "names.json").write_text(json.dumps(given))
    return tmp_path


def test_joints_and_axes_may_be_told(strange: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = strange / "out.npz"
    assert "--names takes a JSON file" in fails(capsys, "convert-poses", strange / "in.bvh", out)
    how = ("--names", strange / "names.json", "--up", "z", "--facing", "-y")
    assert run("convert-poses", strange / "in.bvh", out, *how) == 0
    printed = capsys.readouterr()
    assert "Z up, -Y forward; in centimetres" in printed.err
    assert printed.out == f"6 poses at 30 fps: {out}\n"
    (strange / "plain.bvh").write_text(text(walk().called(TOOLS["cmu"])))
    body = load_anny()
    found, expected = (centres(body, read_motion(strange / name, body)) for name in ("out.npz", "plain.bvh"))
    np.testing.assert_allclose(found, expected, atol=1e-3)


@pytest.mark.parametrize(("names", "said"), [
    ("mixxamo", "--names: expected auto, mixamo, cmu,"),
    ("none.json", "none.json: no such file"),
    ({"tail": "q1"}, "names.json: expected joints of SMPL or of the built-in body, found 'tail'"),
    ({"head": 3}, "names.json: expected the name of a joint for 'head'"),
    ({"head": "q99"}, "in.bvh: expected one joint called 'q99' for head, found none"),
    (["head"], "names.json: expected a JSON object, our joint: their joint, found list"),
])  # fmt: skip
def test_wrong_names_are_one_line(names, said: str, strange: Path, capsys: pytest.CaptureFixture[str]) -> None:
    if not isinstance(names, str):
        (strange / "names.json").write_text(json.dumps(names))
        names = strange / "names.json"
    assert said in fails(capsys, "convert-poses", strange / "in.bvh", strange / "out.npz", "--names", names)
    assert not (strange / "out.npz").exists()


def test_axes_are_not_told_of_poses_of_ours(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_poses(tmp_path / "poses.npz", random_poses(load_anny(), 1))
    said = fails(capsys, "convert-poses", tmp_path / "poses.npz", tmp_path / "out.npz", "--up", "z")
    assert "expected neither --up nor --facing" in said


def test_what_looks_mirrored_is_told(tmp_path: Path) -> None:
    base = walk().called(TOOLS["cmu"])
    flip = np.diag([-1.0, 1, 1])
    (tmp_path / "in.bvh").write_text(text(base.in_axes(flip)))
    notes: list[str] = []
    read_motion(tmp_path / "in.bvh", load_anny(), say=notes.append)
    assert "the file mirrored" in notes[-1]
