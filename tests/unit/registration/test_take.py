"""A take in segments, on a tube around one bending bone: joined, resumed, and registered on where joining fails."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.body.skinning import pose_frame, skin
from capture4d.captures.garment_scans import save_garment_scan
from capture4d.captures.segments import cut
from capture4d.files.arrays import ArrayFile
from capture4d.runs.growing import GrowingStage
from capture4d.runs.made import Ledger
from capture4d.types import Body, Garment, Mesh, PoseSequence
from registration.chain import Chain
from registration.config import RegistrationConfig
from registration.predictions import Mover
from registration.seams import blended
from registration.take import Take, register_take
from registration.template import analyse_template

FRAMES, LENGTH, OVERLAP = 13, 6, 3
IDS = tuple(range(10, 10 + FRAMES))

Registered = Callable[..., Take]


def weights_at(points: np.ndarray) -> np.ndarray:
    top = np.clip((points[:, 1] - 0.15) / 0.2, 0, 1)
    return np.column_stack([1 - top, top]).astype(np.float32)


@pytest.fixture
def registered(garment: Garment, scan_of, config: RegistrationConfig, tmp_path: Path) -> Registered:
    """Registers the take in a folder, as far as that is to be done; the take afterwards."""
    triangle = Mesh(np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], np.float32), np.array([[0, 1, 2]], np.int32))
    body = Body(
        template=triangle,
        shape_directions=np.zeros((1, 3, 3), np.float32),
        joints=np.array([[0, 0, 0], [0, 0.25, 0]], np.float32),
        joint_directions=np.zeros((1, 2, 3), np.float32),
        joint_names=("root", "top"),
        parents=np.array([-1, 0], np.int32),
        skin_weights=np.tile(np.array([[1, 0]], np.float32), (3, 1)),
    )
    rotations = np.tile(np.eye(3, dtype=np.float32), (FRAMES, 2, 1, 1))
    rotations[:, 1] = Rotation.from_euler("z", np.linspace(0, 40, FRAMES)[:, None], degrees=True).as_matrix()
    poses = PoseSequence(
        rotations, np.zeros((FRAMES, 3), np.float32), np.zeros(1, np.float32), np.array(IDS, np.int32), 60.0,
        ("root", "top"),
    )  # fmt: skip
    bound = replace(garment, skin_weights=weights_at(garment.template.vertices))
    analysis = analyse_template(bound, config)
    mover = Mover.create(analysis, body, poses)
    assert mover is not None
    for row, frame_id in enumerate(IDS):
        transforms = pose_frame(mover.shaped, poses, row).transforms
        scan = scan_of(lambda points, posed=transforms: skin(points, weights_at(points), posed), noise=3e-4)
        save_garment_scan(tmp_path / "garment" / "frames" / f"{frame_id:06d}.npz", replace(scan, frame_id=frame_id))

    def register(
        name: str = "work", *, length: int = LENGTH, seam_mm: float = 5.0, workers: int = 1, garments: str = "scan"
    ) -> Take:
        stage = GrowingStage(tmp_path / name, {}, ledger=Ledger.open(tmp_path / name))
        pieces = cut(FRAMES, length, OVERLAP)
        scans, turns = (tuple(f"{what} {each}" for each in IDS) for what in (garments, "pose"))
        chain = Chain(stage.ledger, IDS, "settings", scans, turns, pieces, seam_mm, True)
        # from the skinned pose every frame would come out alike, whatever it started from
        chosen = replace(config, sequence=replace(config.sequence, seam_mm=seam_mm, start="previous"))
        take = Take(analysis, mover, chosen, tmp_path / "garment", stage, chain)
        stage = register_take(take, workers)
        return replace(take, stage=stage, chain=replace(chain, ledger=stage.ledger))

    return register


def vertices(take: Take, folder: str = "frames") -> dict[int, np.ndarray]:
    found = {}
    for path in sorted((take.stage.path / folder).glob("*.npz")):
        with ArrayFile(path) as arrays:
            found[int(path.stem)] = arrays["vertices"]
    return found


def test_segments_are_joined_where_they_overlap(registered: Registered, garment: Garment) -> None:
    take = registered()
    found, tails, leads = (vertices(take, folder) for folder in ("frames", "tails", "leads"))
    assert list(found) == list(IDS)
    assert list(tails) == [14, 15]
    assert list(leads) == [13, 14, 15]
    for frame_id, share in ((14, 1 / 3), (15, 2 / 3)):
        np.testing.assert_array_equal(found[frame_id], blended(tails[frame_id], leads[frame_id], share))
    records = [json.loads(path.read_text()) for path in sorted((take.stage.path / "metrics").glob("*.json"))]
    assert [record["frame_id"] for record in records if "seam_mm" in record] == [14, 15]
    assert {record["verdict"] for record in records} == {"good"}
    assert all(0 < record["seam_mm"] < 5.0 for record in records if "seam_mm" in record)
    whole = vertices(registered("whole", length=FRAMES))
    for frame_id in IDS[:4]:
        np.testing.assert_array_equal(found[frame_id], whole[frame_id])
    # How far a smooth tube turns about itself nothing tells: the two may part, but neither is the worse one.
    mover, rest = take.mover, garment.template.vertices.astype(np.float64)
    assert mover is not None
    poses = (pose_frame(mover.shaped, mover.poses, row) for row in range(FRAMES))
    places = {each: skin(rest, weights_at(rest), pose.transforms) for each, pose in zip(IDS, poses, strict=True)}
    off, off_whole = (
        np.mean([np.linalg.norm(made[each] - places[each], axis=1).mean() for each in IDS]) for made in (found, whole)
    )
    assert off < 1.5 * off_whole


def test_a_segment_that_cannot_be_joined_goes_on_from_the_one_before(registered: Registered) -> None:
    """Frame for frame, bit for bit what one segment gives."""
    found, whole = vertices(registered(seam_mm=0.0)), vertices(registered("whole", length=FRAMES))
    for frame_id in IDS:
        np.testing.assert_array_equal(found[frame_id], whole[frame_id])


@pytest.mark.parametrize(
    ("seam_mm", "gone"),
    [
        (5.0, "leads/000013"),
        (5.0, "tails/000014"),
        (5.0, "frames/000015"),
        (0.0, "leads/000015"),
        (0.0, "tails/000015"),
    ],
)
def test_what_is_missing_is_made_again_and_all_is_as_before(
    registered: Registered, seam_mm: float, gone: str, tmp_path: Path
) -> None:
    before = vertices(registered(seam_mm=seam_mm))
    (tmp_path / "work" / f"{gone}.npz").unlink()
    after = vertices(registered(seam_mm=seam_mm))
    for frame_id in IDS:
        np.testing.assert_array_equal(before[frame_id], after[frame_id])


def test_what_stands_is_not_made_again(registered: Registered, tmp_path: Path) -> None:
    take = registered()
    todo = take.chain.todo()
    assert (todo.is_any, todo.certain, todo.following) == (False, (), ())
    times = {path: path.stat().st_mtime_ns for path in (tmp_path / "work").rglob("*.npz")}
    registered()
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "work").rglob("*.npz")} == times


def test_other_garments_are_other_frames(registered: Registered) -> None:
    chain = registered().chain
    other = replace(chain, garments=tuple(f"other {each}" for each in IDS[:8]) + chain.garments[8:])
    todo = other.todo()
    assert {*todo.certain} >= {0}
    assert {*todo.certain, *todo.following} == {*range(FRAMES)}
    last = replace(chain, garments=(*chain.garments[:-1], "other")).todo()
    assert (last.certain, last.following, [each.index for each in last.register]) == ((12,), (), [1])


def test_a_garment_that_cannot_be_read_between_two_segments_is_flagged(registered: Registered, tmp_path: Path) -> None:
    (tmp_path / "garment" / "frames" / "000015.npz").write_bytes(b"PK")
    take = registered()
    record = json.loads((take.stage.path / "metrics" / "000015.json").read_text())
    assert record["verdict"] == "failed"
    assert "000015.npz" in record["reasons"][0]
    assert list(vertices(take)) == list(IDS)


@pytest.mark.slow
@pytest.mark.parametrize("seam_mm", [0.0, 5.0])
def test_two_processes_give_the_same_files(registered: Registered, seam_mm: float) -> None:
    one, two = registered("one", seam_mm=seam_mm), registered("two", seam_mm=seam_mm, workers=2)
    paths = [[each.chain.file(at) for at in range(FRAMES)] for each in (one, two)]
    assert one.stage.digest_of_all(paths[0]) == two.stage.digest_of_all(paths[1])
