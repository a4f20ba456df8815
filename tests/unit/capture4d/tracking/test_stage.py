"""The tracking stage: a capture without poses gets them, and an interrupted run ends in the same files."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree

from benchmarks.dressed_body import dress_body
from capture4d.body.anny import load_anny
from capture4d.body.posed_surface import BodyState
from capture4d.body.skinning import pose_frame, with_shape
from capture4d.captures.capture import Capture, read_capture, write_capture_description, write_scan
from capture4d.captures.work_folder import load_tracking, tracking_digest
from capture4d.errors import InputError
from capture4d.files.atomic import read_json
from capture4d.files.records import save_body, save_poses
from capture4d.geometry.mesh import submesh
from capture4d.motions.retargeting import pose_sequence
from capture4d.tracking import first_pass
from capture4d.tracking.config import TrackingConfig
from capture4d.tracking.sequence import Followed, Quality
from capture4d.tracking.stage import run
from capture4d.types import Mesh, PoseSequence, Scan

CLOTH, SUIT = (47, 98, 201), (150, 152, 156)


def dressed_capture(folder: Path, frames: int, *, without: dict[int, tuple[str, ...]] | None = None) -> PoseSequence:
    """Noise-free scans of the built-in body that raises its arms, and the poses, which are not in the capture.

    Args:
        without: joints, by row of the frame, whose part of the body the scan lacks.
    """
    body = load_anny()
    person = with_shape(body, np.array([0.6, -0.4], np.float32))
    rotations = np.tile(np.eye(3), (frames, len(body.joint_names), 1, 1))
    for frame in range(frames):
        angle = 0.05 * frame
        turn = [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
        rotations[frame, body.joint_names.index("upperarm01.L")] = turn
    poses = pose_sequence(person, rotations, 30.0)
    poses = replace(poses, frame_ids=np.arange(5, 5 + frames, dtype=np.int32))
    capture = Capture(folder, "shell", 30.0, tuple(range(5, 5 + frames)), CLOTH, {})
    for row, frame_id in enumerate(capture.frame_ids):
        dressed = dress_body(pose_frame(person, poses, row), 0.1 * row)
        bare, cloth = dressed.body, dressed.garment
        lost = [body.joint_names.index(name) for name in (without or {}).get(row, ())]
        if lost:
            skin = pose_frame(person, poses, row).vertices()
            weight = body.skin_weights[:, lost].sum(axis=1)[KDTree(skin).query(bare.vertices)[1]]
            bare = submesh(bare, (weight[bare.faces] < 0.05).all(axis=1))[0]
        mesh = Mesh(
            np.concatenate([bare.vertices, cloth.vertices]),
            np.concatenate([bare.faces, cloth.faces + np.int32(len(bare.vertices))]),
        )
        colours = np.array([SUIT] * len(bare.vertices) + [CLOTH] * len(cloth.vertices), np.uint8)
        write_scan(folder / "scans" / f"{frame_id:06d}.ply", Scan(mesh, colours, frame_id, 0.0))
    save_body(folder / "body.npz", body)
    write_capture_description(capture)
    return poses


@pytest.mark.slow
def test_a_take_is_tracked_and_a_run_that_was_cut_short_ends_the_same(tmp_path: Path) -> None:
    truth = dressed_capture(tmp_path / "capture", 4)
    save_poses(tmp_path / "start.npz", truth)
    config = TrackingConfig(start=str(tmp_path / "start.npz"))
    digest = run(read_capture(tmp_path / "capture"), tmp_path / "work" / "body", config).digest
    body, found = load_tracking(tmp_path / "work" / "body")
    assert found.frame_ids.tolist() == [5, 6, 7, 8]
    here, there = with_shape(body, found.shape), with_shape(body, truth.shape)
    for row in range(4):
        apart = pose_frame(here, found, row).vertices() - pose_frame(there, truth, row).vertices()
        assert np.linalg.norm(apart, axis=1).mean() < 0.006
    metrics = read_json(tmp_path / "work" / "body" / "metrics" / "000006.json")
    assert metrics["verdict"] == "good"

    (tmp_path / "work" / "body" / "frames" / "000008.npz").unlink()
    (tmp_path / "work" / "body" / "refined" / "000006.npz").unlink()
    assert run(read_capture(tmp_path / "capture"), tmp_path / "work" / "body", config).digest == digest
    assert tracking_digest(tmp_path / "work" / "body", read_capture(tmp_path / "capture")) == digest


@pytest.mark.slow
def test_a_frame_says_which_limbs_nobody_scanned_and_what_is_wrong_with_its_scan(tmp_path: Path) -> None:
    arm = ("lowerarm01.R", "lowerarm02.R", "wrist.R")
    truth = dressed_capture(tmp_path / "capture", 5, without={2: arm})
    save_poses(tmp_path / "start.npz", truth)
    for frame in ("000005", "000009"):
        path = tmp_path / "capture" / "scans" / f"{frame}.ply"
        path.write_bytes(path.read_bytes()[:5000])
    run(read_capture(tmp_path / "capture"), tmp_path / "body", TrackingConfig(start=str(tmp_path / "start.npz")))
    records = [json.loads(line) for line in (tmp_path / "body" / "metrics.jsonl").read_text().splitlines()]
    assert [record["verdict"] for record in records] == ["lost", "good", "check", "good", "lost"]
    assert [record["unseen"] for record in records[1:4]] == [[], ["right forearm", "right hand"], []]
    assert records[2]["reasons"] == ["not scanned, so guessed: right forearm, right hand"]
    for record, name in ((records[0], "000005.ply"), (records[4], "000009.ply")):
        assert f"{name}: cut off" in record["reasons"][0]
    body, found = load_tracking(tmp_path / "body")
    here, there = with_shape(body, found.shape), with_shape(body, truth.shape)
    apart = pose_frame(here, found, 0).vertices() - pose_frame(there, truth, 0).vertices()
    assert np.linalg.norm(apart, axis=1).mean() < 0.02, "a lost first frame has the pose of the next one"


@pytest.mark.parametrize("writer", ["write_json", "write_npz"])
def test_a_frame_is_done_once_all_its_files_are_written(
    writer: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed right after any of its files, the frame is either still to be done or whole."""
    write = getattr(first_pass, writer)

    def write_and_die(path: Path, *arguments: object, **arrays: object) -> None:
        write(path, *arguments, **arrays)
        raise KeyboardInterrupt

    monkeypatch.setattr(first_pass, writer, write_and_die)
    state = BodyState(np.eye(3)[None], np.zeros(3), np.zeros(2))
    followed = Followed(state, np.zeros((2, 2)), Quality((), False, 1.0, 0.001, 0.0), "start", 0, 0)
    path = tmp_path / "frames" / "000005.npz"
    with pytest.raises(KeyboardInterrupt):
        first_pass._save_followed(path, followed, 0.1)
    assert not path.is_file() or (tmp_path / "times" / "000005.json").is_file()


def test_nothing_but_damaged_scans_is_an_error_again_and_again(tmp_path: Path) -> None:
    dressed_capture(tmp_path / "capture", 2)
    for path in (tmp_path / "capture" / "scans").iterdir():
        path.write_bytes(b"ply")
    for _ in range(2):
        with pytest.raises(InputError, match=r"000005\.ply: "):
            run(read_capture(tmp_path / "capture"), tmp_path / "work" / "body", TrackingConfig(start="rest"))
    with pytest.raises(InputError, match="'track' is not finished"):
        tracking_digest(tmp_path / "work" / "body", read_capture(tmp_path / "capture"))


def test_a_start_that_overwriting_would_delete_is_refused(tmp_path: Path) -> None:
    dressed_capture(tmp_path / "capture", 1)
    body = tmp_path / "work" / "body"
    body.mkdir(parents=True)
    (body / "poses.npz").write_bytes(b"an earlier run's")
    with pytest.raises(InputError, match=r"poses\.npz: start: expected a motion file outside of the folder"):
        run(read_capture(tmp_path / "capture"), body, TrackingConfig(start=str(body / "poses.npz")), overwrite=True)
    assert (body / "poses.npz").read_bytes() == b"an earlier run's"


def test_a_start_that_is_no_file_and_a_stage_that_was_not_run(tmp_path: Path) -> None:
    dressed_capture(tmp_path / "capture", 1)
    with pytest.raises(InputError, match="expected search, rest or a motion file, found 'nowhere'"):
        run(read_capture(tmp_path / "capture"), tmp_path / "work" / "body", TrackingConfig(start="nowhere"))
    with pytest.raises(InputError, match="run: capture4d track"):
        tracking_digest(tmp_path / "work" / "body", read_capture(tmp_path / "capture"))
