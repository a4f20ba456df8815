"""Body tracking against exact poses, on takes seen only as scans.

Three kinds of data, of bodies whose shape the tracker does not know:

    takes    a range-of-motion clip and a CMU clip (`shared/data/mocap` beside the project; a scripted clip without it),
             in a shell of cloth, points sampled with noise and holes: quick to make, so many frames
    scanner  a few frames of the same, seen by the virtual cameras and tracked as a capture, from files
    motions  every BVH clip beside that one (a scripted clip without any), out and in again in all formats
    cloth    a simulated T-shirt from the synthetic scanner, with registration by tracked and by true poses

The tracker's body is the one that the scans are of, skinned as the tracker skins it. Real people are neither: the
figures are lower bounds.

Joints that count: root, spine, neck, head, clavicles, shoulders, elbows, wrists, hips, knees and ankles; in `cloth`,
whose cameras look at the upper body, those with scan points within 12 cm; in `scanner`, whose coarse scans lack hands,
and now and then a whole arm, those whose own part of the body was scanned.

Limits this was built against: joint_mean_mm 5 and joint_p99_mm 20 over 200 frames, cold_start_right 38 of 40,
skin_mean_mm 3, warm_cpu_s 0.5, motion_round_trip_mm 1, registration with tracked poses at most 1.15 times that with
true ones.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from benchmarks.dressed_body import covered_vertices, dress_body, sample_scan
from benchmarks.metric import Metric
from capture4d import pipeline
from capture4d.body.anny import load_anny
from capture4d.body.skinning import PosedBody, ShapedBody, pose_frame, with_pose, with_shape
from capture4d.captures.capture import Capture, read_capture, read_scan, write_capture_description, write_scan
from capture4d.captures.work_folder import load_tracking
from capture4d.files.arrays import ArrayFile
from capture4d.files.atomic import read_json
from capture4d.files.records import load_poses, save_body, save_poses
from capture4d.motions.bvh import read_bvh
from capture4d.motions.clips import understood
from capture4d.motions.motion_files import read_motion, write_motion
from capture4d.motions.retargeting import retarget
from capture4d.motions.sources import acknowledgement
from capture4d.tracking.config import TrackingConfig
from capture4d.tracking.sequence import Followed, Tracker
from capture4d.tracking.stage import run as track
from capture4d.types import Body, PoseSequence

MOCAP = Path(__file__).resolve().parents[2] / "shared" / "data" / "mocap" / "cmu_131_03_start_hop_stop.bvh"
JOINTS = (
    "root", "spine", "neck", "head", "clavicle", "upperarm01", "lowerarm01", "wrist", "upperleg01", "lowerleg01",
    "foot",
)  # fmt: skip
SHAPES = ((1.2, -0.8, 0.7, 0.5, -0.6, 0.4), (-1.0, 1.1, -0.5, 0.6, 0.3, -0.4))
RIGHT_MM = 30.0
SHOWN_M = 0.12
CLOTH, SUIT = (47, 98, 201), (150, 152, 156)


def run(
    *,
    quick: bool = False,
    frames: int = 110,
    cold_starts: int = 40,
    scanned: int = 12,
    cloth: bool = True,
    capture: Path | None = None,
    mocap: Path = MOCAP,
    seed: int = 0,
) -> list[Metric]:
    """Track takes of known motion, and find poses from nowhere.

    Args:
        quick: fewer frames and cold starts; the same keys.
        frames: of each of the two takes.
        cold_starts: random facings and arm poses.
        scanned: frames that go through the virtual cameras.
        cloth: track and register a simulated T-shirt as well.
        capture: capture folder with truth to do that on, instead of the cached `demo` take.
        mocap: BVH file of the second take; a scripted clip where there is none.
        seed: of noise, holes and random poses.
    """
    if quick:
        frames, cold_starts, scanned = 15, 4, 3
    body, console = load_anny(), Console(stderr=True)
    tracker = Tracker.create(body, TrackingConfig())
    takes = [
        _track_take(tracker, poses, np.random.default_rng([seed, k])) for k, poses in _motions(body, frames, mocap)
    ]
    joint_mm = np.concatenate([take.joint_mm for take in takes])
    metrics = [
        Metric("joint_mean_mm", float(joint_mm.mean()), "mm"),
        Metric("joint_p99_mm", float(np.percentile(joint_mm, 99)), "mm"),
        Metric("skin_mean_mm", float(np.mean([take.skin_mm for take in takes])), "mm"),
        Metric("warm_cpu_s", float(np.median(np.concatenate([take.cpu_s for take in takes]))), "s"),
        Metric("flagged_percent", 100 * float(np.mean([take.flagged for take in takes])), "%"),
        Metric("frames", float(sum(len(take.cpu_s) for take in takes)), "", "higher"),
    ]
    if mocap.is_file():
        console.print(acknowledgement(mocap) or "", soft_wrap=True)
    console.print("\n".join(f"{metric.key} {metric.value:.3f}" for metric in metrics))
    metrics += _cold_starts(tracker, cold_starts, np.random.default_rng([seed, 10]), console)
    with tempfile.TemporaryDirectory(prefix="capture4d-tracking-") as scratch:
        metrics += _round_trips(body, mocap, Path(scratch), quick=quick)
        metrics += _scanner(body, scanned, Path(scratch), mocap, seed)
        if cloth:
            metrics += _cloth(capture or _simulated(quick), Path(scratch))
    return metrics


def _motions(body: Body, frames: int, mocap: Path) -> Iterator[tuple[int, PoseSequence]]:
    from data_synth.motions import CLIPS, scripted_clip

    people = [with_shape(body, np.array(shape, np.float32)) for shape in SHAPES]
    rng = np.random.default_rng(0)
    yield 0, scripted_clip(people[0], CLIPS["range-of-motion"], 60.0, frames, rng)
    if mocap.is_file():
        yield 1, _cut(retarget(people[1], understood(read_bvh(mocap))[0], 60.0, first_frame=120), frames)
    else:
        yield 1, scripted_clip(people[1], CLIPS["reach"], 60.0, frames, rng)


def _cut(poses: PoseSequence, frames: int) -> PoseSequence:
    return replace(
        poses,
        rotations=poses.rotations[:frames],
        translations=poses.translations[:frames],
        frame_ids=poses.frame_ids[:frames],
    )


# --- points ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Tracked:
    joint_mm: np.ndarray
    """(T, counted joints)."""
    skin_mm: float
    cpu_s: np.ndarray
    """(T - 1,) both passes of every frame but the first."""
    flagged: float


def _track_take(tracker: Tracker, truth: PoseSequence, rng: np.random.Generator) -> _Tracked:
    """Both passes over a take, its first frame searched for."""
    body = tracker.model.body
    person = with_shape(body, truth.shape)
    scans = [
        sample_scan(dress_body(pose_frame(person, truth, t), t / truth.fps), rng) for t in range(len(truth.frame_ids))
    ]
    followed: list[Followed] = []
    seconds = np.zeros(len(scans))
    for t, scan in enumerate(scans):
        begin = time.process_time()
        found = tracker.follow(scan, followed[-1], followed[-2] if t > 1 else None) if t else tracker.begin(scan, None)
        followed.append(found)
        seconds[t] = time.process_time() - begin
    shape = followed[-1].state.shape
    errors, flagged = [], 0
    for t, scan in enumerate(scans):
        begin = time.process_time()
        around = [followed[t - 1].state, followed[t + 1].state] if 0 < t < len(scans) - 1 else []
        start = replace(followed[t].state, shape=shape)
        refined = tracker.refine(scan, start, around, interval_s=1 / truth.fps, lost=followed[t].quality.lost)
        seconds[t] += time.process_time() - begin
        flagged += bool(refined.quality.reasons)
        found = with_pose(with_shape(body, shape), refined.state.rotations, refined.state.translation)
        errors.append(_joint_errors_mm(found, pose_frame(person, truth, t)))
    skin = with_shape(body, shape).vertices - person.vertices
    bare = _bare(body)
    return _Tracked(
        joint_mm=np.array(errors)[:, _counted(body)],
        skin_mm=1e3 * float(np.linalg.norm(skin[bare], axis=1).mean()),
        cpu_s=seconds[1:],
        flagged=flagged / len(scans),
    )


def _counted(body: Body) -> np.ndarray:
    return np.array([name.startswith(JOINTS) for name in body.joint_names])


def _bare(body: Body) -> np.ndarray:
    """Vertices outside of the shell of cloth."""
    return ~covered_vertices(body)


def _joint_errors_mm(found: PosedBody, true: PosedBody) -> np.ndarray:
    return 1e3 * np.linalg.norm(found.joint_centres() - true.joint_centres(), axis=1)


# --- cold starts -------------------------------------------------------------------------------------------------


def _cold_starts(tracker: Tracker, count: int, rng: np.random.Generator, console: Console) -> list[Metric]:
    body = tracker.model.body
    right, seconds = 0, []
    for number in range(count):
        true = _random_person(body, rng)
        scan = sample_scan(dress_body(true, rng.uniform(0, 9)), rng)
        begin = time.process_time()
        state = tracker.begin(scan, None).state
        seconds.append(time.process_time() - begin)
        found = with_pose(with_shape(body, state.shape), state.rotations, state.translation)
        worst = float(_joint_errors_mm(found, true)[_counted(body)].max())
        right += worst < RIGHT_MM
        console.print(f"cold start {number}: worst joint {worst:.1f} mm")
    return [
        Metric("cold_start_right", float(right), f"of {count}", "higher"),
        Metric("cold_start_cpu_s", float(np.median(seconds)), "s"),
    ]


def _random_person(body: Body, rng: np.random.Generator) -> PosedBody:
    """Any facing, any arm pose that does not enter the trunk, legs nearly straight, anybody."""
    from data_synth.motions import random_pose

    person = with_shape(body, rng.normal(0, 0.8, 6).astype(np.float32))
    rotations = random_pose(person, rng)
    rotations[0] = Rotation.from_euler("y", rng.uniform(0, 360), degrees=True).as_matrix()
    for side in "LR":
        leg = body.joint_names.index(f"upperleg01.{side}")
        rotations[leg] = Rotation.from_rotvec(rng.normal(0, 0.15, 3)).as_matrix()
    return with_pose(person, rotations, rng.uniform(-0.3, 0.3, 3) * (1.0, 0.1, 1.0))


# --- motion files ------------------------------------------------------------------------------------------------


def _round_trips(body: Body, mocap: Path, scratch: Path, *, quick: bool) -> list[Metric]:
    """Joint positions of clips after BVH, npz and AMASS npz; and from AMASS's own arrays, as other readers see them."""
    clips = [read_motion(path, body, fps=60.0) for path in sorted(mocap.parent.glob("*.bvh"))]
    if not clips:
        clips = [replace(poses, shape=np.zeros(0, np.float32)) for _, poses in _motions(body, 30, mocap)]
    worst, plain = 0.0, 0.0
    for poses in clips[:1] if quick else clips:
        places = _joint_places(body, poses)
        for name, amass in (("clip.bvh", False), ("clip.npz", False), ("amass.npz", True)):
            write_motion(scratch / name, body, poses, amass=amass)
            worst = max(worst, _farthest_mm(places, _joint_places(body, read_motion(scratch / name, body))))
        with np.load(scratch / "amass.npz") as arrays:
            kept = {name: arrays[name] for name in arrays.files if not name.startswith("capture4d_")}
        np.savez(scratch / "plain.npz", **kept)
        seen = read_motion(scratch / "plain.npz", body)
        plain = max(plain, _farthest_mm(places, _joint_places(body, seen)))
    return [Metric("motion_round_trip_mm", worst, "mm"), Metric("amass_alone_mm", plain, "mm")]


def _joint_places(body: Body, poses: PoseSequence) -> np.ndarray:
    person = with_shape(body, poses.shape)
    return np.stack([pose_frame(person, poses, t).joint_centres() for t in range(len(poses.frame_ids))])


def _farthest_mm(here: np.ndarray, there: np.ndarray) -> float:
    return 1e3 * float(np.linalg.norm(here - there, axis=2).max())


# --- through the cameras -----------------------------------------------------------------------------------------


def _scanner(body: Body, frames: int, scratch: Path, mocap: Path, seed: int) -> list[Metric]:
    """A capture of the shell, seen by cameras all round and tracked from its files."""
    from data_synth.scanner.config import ScannerConfig
    from data_synth.scanner.rig import capture_rig
    from data_synth.scanner.scan import LABEL_BODY, LABEL_GARMENT, Surface, scan_surfaces

    person = with_shape(body, np.array(SHAPES[1], np.float32))
    _, truth = list(_motions(body, 4 * frames, mocap))[1]
    rig = capture_rig(centre=(0.0, 0.95, 0.0), radius=1.1, cameras=24)
    config = ScannerConfig()
    capture = Capture(scratch / "scanned", "shell", truth.fps / 4, tuple(range(1, frames + 1)), CLOTH, {})
    for frame_id in capture.frame_ids:
        row = 4 * (frame_id - 1)
        dressed = dress_body(pose_frame(person, truth, row), row / truth.fps)
        surfaces = [
            Surface(mesh, np.tile(np.array(colour, np.uint8), (len(mesh.vertices), 1)), label, 0.008)
            for mesh, colour, label in ((dressed.body, SUIT, LABEL_BODY), (dressed.garment, CLOTH, LABEL_GARMENT))
        ]
        shift = truth.translations[row] * (1.0, 0.0, 1.0)
        moved = replace(rig, T_camera_world=rig.T_camera_world @ _shift(-shift))
        rng = np.random.default_rng([seed, 20, frame_id])
        scan, _ = scan_surfaces(moved, surfaces, config=config, rng=rng, frame_id=frame_id)
        write_scan(capture.path / "scans" / f"{frame_id:06d}.ply", scan)
    write_capture_description(capture)
    save_body(capture.path / "body.npz", body)
    track(capture, scratch / "scanned-body", TrackingConfig())
    _, poses = load_tracking(scratch / "scanned-body")
    rows = 4 * np.arange(frames)
    seen = replace(
        truth,
        rotations=truth.rotations[rows],
        translations=truth.translations[rows],
        frame_ids=np.array(capture.frame_ids, np.int32),
    )
    scanned = np.stack([_scanned_joints(scratch / "scanned-body", frame_id) for frame_id in capture.frame_ids])
    errors = _sequence_errors_mm(body, poses, seen)[_counted(body) & scanned]
    skin = with_shape(body, poses.shape).vertices - person.vertices
    return [
        Metric("scanner_joints_seen_percent", 100 * float(scanned[:, _counted(body)].mean()), "%", "higher"),
        Metric("scanner_joint_mean_mm", float(errors.mean()), "mm"),
        Metric("scanner_joint_p99_mm", float(np.percentile(errors, 99)), "mm"),
        Metric("scanner_skin_mean_mm", 1e3 * float(np.linalg.norm(skin[_bare(body)], axis=1).mean()), "mm"),
    ]


def _scanned_joints(folder: Path, frame_id: int) -> np.ndarray:
    """Joints whose own part of the body has scan points; the others follow their prior, which no scan can mend."""
    with ArrayFile(folder / "refined" / f"{frame_id:06d}.npz") as arrays:
        return arrays["seen"]


def _shift(by: np.ndarray) -> np.ndarray:
    transform = np.eye(4)
    transform[:3, 3] = by
    return transform


def _sequence_errors_mm(body: Body, found: PoseSequence, true: PoseSequence) -> np.ndarray:
    here, there = with_shape(body, found.shape), with_shape(body, true.shape)
    return np.array(
        [_joint_errors_mm(pose_frame(here, found, t), pose_frame(there, true, t)) for t in range(len(found.frame_ids))]
    )


# --- simulated cloth ---------------------------------------------------------------------------------------------


def _simulated(quick: bool) -> Path:
    from benchmarks.cached_takes import cached_take
    from data_synth.config import PRESETS

    return cached_take(replace(PRESETS["tiny"], frames=12, capture_every=1) if quick else PRESETS["demo"])


def _cloth(folder: Path, scratch: Path) -> list[Metric]:
    """Track a T-shirt take as if it had brought no poses, and register it with those and with the true ones."""
    capture = read_capture(folder)
    truth = load_poses(folder / "truth" / "poses.npz")
    scores = {}
    for name in ("tracked", "true"):
        blind = _without_poses(capture, scratch / name)
        if name == "true":
            save_poses(blind / "poses.npz", truth)
        scores[name] = _register(blind, scratch / f"{name}-work", tracked=name == "tracked")
    body, poses = load_tracking(scratch / "tracked-work" / "body")
    person = with_shape(body, truth.shape)
    counted = _counted(body) & np.array([_shown(capture, person, truth, t) for t in range(len(truth.frame_ids))])
    errors = _sequence_errors_mm(body, poses, truth)[counted]
    warm = [
        read_json(path)["cpu_s"] for path in sorted((scratch / "tracked-work" / "body" / "metrics").glob("*.json"))
    ][1:]
    metrics = [
        Metric("cloth_joint_mean_mm", float(errors.mean()), "mm"),
        Metric("cloth_joint_p99_mm", float(np.percentile(errors, 99)), "mm"),
        Metric(
            "cloth_skin_mean_mm",
            1e3 * float(np.linalg.norm(with_shape(body, poses.shape).vertices - person.vertices, axis=1).mean()),
            "mm",
        ),
        Metric("cloth_warm_cpu_s", float(np.median(warm)), "s"),
    ]
    for key in ("truth_distance_mean_mm", "border_mean_mm", "correspondence_mean_mm"):
        metrics.append(Metric(f"tracked_{key}", scores["tracked"][key], "mm"))
        ratio = scores["tracked"][key] / scores["true"][key]
        metrics.append(Metric(f"tracked_to_true_{key.removesuffix('_mm')}", ratio))
    return metrics


def _without_poses(capture: Capture, folder: Path) -> Path:
    """The same take as a capture of links to it, but for its poses."""
    folder.mkdir()
    for path in capture.path.iterdir():
        if path.name not in ("poses.npz", "stage.json"):
            (folder / path.name).symlink_to(path.resolve())
    return folder


def _register(capture: Path, work: Path, *, tracked: bool) -> dict[str, float]:
    pipeline.extract(capture, work)
    if tracked:
        pipeline.track(capture, work)
    pipeline.register(capture, work, tracked=tracked)
    pipeline.report(work, capture=capture)
    return {entry["key"]: entry["value"] for entry in read_json(work / "report" / "metrics.json")["metrics"]}


def _shown(capture: Capture, person: ShapedBody, truth: PoseSequence, row: int) -> np.ndarray:
    """Joints near which there is anything of the scan."""
    tree = KDTree(read_scan(capture, int(truth.frame_ids[row])).mesh.vertices[::20])
    return tree.query(pose_frame(person, truth, row).joint_centres())[0] < SHOWN_M
