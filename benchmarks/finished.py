"""How long `capture4d run` takes to say that a long take is finished, after one of its scans was copied anew.

The take is made up: its scans are one small tube of cloth, its frames were registered once, and what the stages would
have written for the others is put there, with what it was made from. So the time is that of looking at a take, which
does not depend on how large scans are.
"""

from __future__ import annotations

import hashlib
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path

import numpy as np

from benchmarks.metric import Metric
from capture4d import pipeline
from capture4d.app.report import take as report
from capture4d.body.anny import load_anny
from capture4d.captures.capture import Capture, read_capture, write_capture_description, write_scan
from capture4d.captures.scan_states import as_it_is_now, scan_digest
from capture4d.captures.take_colours import take_colours
from capture4d.files.atomic import write_json
from capture4d.files.records import save_body, save_garment
from capture4d.geometry.mesh import boundary_loops
from capture4d.runs.growing import GrowingStage
from capture4d.runs.made import FileState, Ledger, Made, digest_of
from capture4d.runs.stage import read_record
from capture4d.tracking import first_pass, second_pass
from capture4d.tracking import stage as tracking
from capture4d.tracking.config import TrackingConfig
from capture4d.tracking.take import TrackedTake, take_shape
from capture4d.types import Garment, Mesh, Scan

CLOTH, PAINT = (47, 98, 201), (255, 210, 0)
OLD_S = 3600
"""Scans are so old that their times are believed."""


def run(*, quick: bool = False, frames: int = 10_000) -> list[Metric]:
    """Time `capture4d run` on a finished take.

    Args:
        quick: a tenth of the frames.
        frames: of the take; tracked, extracted and registered.
    """
    count = frames // 10 if quick else frames
    with tempfile.TemporaryDirectory(prefix="capture4d-finished-") as scratch:
        capture, work = Path(scratch) / "capture", Path(scratch) / "work"
        _write_take(capture, range(1, 4))
        pipeline.extract(capture, work)
        pipeline.register(capture, work)
        _write_take(capture, range(1, count + 1))
        _make_up(read_capture(capture), work)
        _command(capture, work)  # settles what was made up
        before = {path: path.stat().st_mtime_ns for path in work.rglob("*.npz")}
        wall_s, cpu_s = _command(capture, work)
        assert {path: path.stat().st_mtime_ns for path in work.rglob("*.npz")} == before, "nothing was to be done"
        files = read_capture(capture).files
        assert files is not None, "the capture was read from a folder"
        os.utime(next(iter(files.scans.values())))
        copied_s, _ = _command(capture, work)
        nothing_s = _command(None, None)[1]
        reference_s = _reference(work)
    return [
        Metric("frames", count, "", "higher"),
        Metric("finished_s", wall_s, "s"),
        Metric("finished_copied_s", copied_s, "s"),
        Metric("finished_cpu_s", cpu_s, "s"),
        Metric("start_cpu_s", nothing_s, "s"),
        Metric("cpu_over_looking_once", (cpu_s - nothing_s) / reference_s),
    ]


def _command(capture: Path | None, work: Path | None) -> tuple[float, float]:
    """Seconds of wall and of CPU of a run, or of a command that does nothing but load what a run loads."""
    arguments = ["-m", "capture4d", "run", str(capture), "--output", str(work), "--tracked", "--workers", "1"]
    if capture is None:
        arguments = ["-c", "import capture4d.extraction.stage, capture4d.tracking.stage, registration.stage"]
    begin, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.perf_counter() - begin, cpu_s


def _reference(work: Path) -> float:
    """CPU seconds of looking once at every frame's file, and of reading once what is known of it."""
    begin = time.process_time()
    for ledger in work.glob("*/made.jsonl"):
        for line in ledger.read_text().splitlines():
            os.stat(ledger.parent / json.loads(line)["path"])
    return time.process_time() - begin


# --- a take that is made up --------------------------------------------------------------------------------------


def _tube(around: int, along: int) -> Mesh:
    angle = np.tile(2 * np.pi * np.arange(around) / around, along)
    height = np.repeat(np.linspace(0, 0.6, along), around)
    at = np.arange(around * (along - 1)).reshape(along - 1, around)
    beside = np.roll(at, -1, axis=1)
    lower = np.stack([at, beside, at + around], axis=-1).reshape(-1, 3)
    upper = np.stack([beside, beside + around, at + around], axis=-1).reshape(-1, 3)
    vertices = np.stack([0.15 * np.sin(angle), height, 0.15 * np.cos(angle)], axis=1)
    return Mesh(vertices.astype(np.float32), np.concatenate([lower, upper]).astype(np.int32))


def _write_take(folder: Path, frames: range) -> None:
    """The same scan as every frame."""
    capture = Capture(folder, "finished", 60.0, tuple(frames), CLOTH, {"hem": PAINT, "neck": PAINT})
    mesh = _tube(48, 50)
    painted = (mesh.vertices[:, 1] < 0.02) | (mesh.vertices[:, 1] > 0.58)
    colours = np.where(painted[:, None], PAINT, CLOTH).astype(np.uint8)
    first = folder / "scans" / "000001.ply"
    if not first.is_file():
        write_scan(first, Scan(mesh, colours, 1, 0.0))
    template = _tube(24, 14)
    hem, neck = sorted(boundary_loops(template.faces), key=lambda loop: template.vertices[loop, 1].mean())
    save_garment(folder / "template.npz", Garment(template, {"hem": hem, "neck": neck}))
    write_capture_description(capture)
    old = time.time() - OLD_S
    for frame_id in frames:
        path = folder / "scans" / f"{frame_id:06d}.ply"
        if path != first:
            shutil.copyfile(first, path)
        os.utime(path, (old, old))


def _make_up(capture: Capture, work: Path) -> None:
    """What the stages would have written."""
    _copy_frames(capture, work / "garment", with_scan=True)
    _copy_frames(capture, work / "registration", with_scan=False)
    for path in ((work / "registration" / "metrics" / f"{each:06d}.json") for each in capture.frame_ids[3:]):
        row = json.loads((path.parent / "000003.json").read_text())
        path.write_text(json.dumps({**row, "frame_id": int(path.stem)}))
    _make_up_tracking(capture, work / "body")
    pipeline.extract(capture, work)
    pipeline.track(capture, work)
    pipeline.register(capture, work, tracked=True)
    registered = read_record(work / "registration" / "stage.json")
    said = [capture.name, capture.entries("fps", "units", "garment_colour", "boundary_colours")]
    upstream = {
        "registration": registered["digest"],
        "settings of the registration": digest_of(registered["config"]),
        "capture.json": digest_of(said),
    }
    record = {"stage": "report", "schema": report.SCHEMA, "config": asdict(report.DEFAULT), "upstream": upstream}
    for name in ("index.html", "metrics.json"):
        write_json(work / "report" / name, {"metrics": []})
    write_json(work / "report" / "stage.json", {**record, "status": "complete", "digest": "0"})


def _copy_frames(capture: Capture, folder: Path, *, with_scan: bool) -> None:
    """The third frame as all that come after it: made from the same scan, and from the same frame before."""
    ledger = Ledger.open(folder)
    third = folder / "frames" / "000003.npz"
    made = ledger.of(third)
    assert made is not None
    for frame_id, path in _paths(capture, folder / "frames"):
        if path.name > third.name:
            shutil.copyfile(third, path)
            inputs = made.inputs if with_scan else {**made.inputs, "start": f"{made.digest} "}
            files = _scan(capture, frame_id) if with_scan else ()
            ledger.note(path, replace(made, time_ns=path.stat().st_mtime_ns, files=files, inputs=inputs))
    ledger.settle()


def _make_up_tracking(capture: Capture, folder: Path) -> None:
    """Both passes of a body that stands still."""
    body, config = load_anny(), TrackingConfig()
    write_json(
        folder / "stage.json",
        {"stage": "track", "schema": tracking.SCHEMA, "config": config, "upstream": {}, "status": "running"},
    )
    stage = GrowingStage(folder, {}, ledger=Ledger.open(folder))
    stage.make(folder / "body.npz", lambda: save_body(folder / "body.npz", body), inputs={"body": "built-in"})
    take = TrackedTake(capture, stage, config, take_colours(capture))
    model = take.tracker().model.rest_state()
    joints = len(body.joint_names)
    for name in ("frames", "leads", "refined", "metrics"):
        (folder / name).mkdir(exist_ok=True)
    np.savez(folder / "first.npz", rotations=model.rotations, translation=model.translation, shape=model.shape,
             shape_information=np.diag(0 * model.shape), numbers=np.array([0.0, 1, 0, 0]),
             reasons=np.array([], np.str_), started_from=np.array("motion"),
             lost_frames=0, doubtful_frames=0)  # fmt: skip
    np.savez(folder / "second.npz", rotations=model.rotations.astype(np.float32),
             translation=model.translation.astype(np.float32), seen=np.ones(joints, bool))  # fmt: skip
    first, said = first_pass.FirstPass.of(take), {"nothing": False, "lost": False, "good": True, "lost_frames": 0}
    for segment in take.segments:
        chain = first_pass.Chain()
        for frame_id, path in [*first.leads(segment).items(), *first.frames(segment).items()]:
            made = _put(capture, folder / "first.npz", path, frame_id, chain.inputs(first.settings, frame_id))
            stage.ledger.note(path, replace(made, said=said))
            chain = chain.followed_by(path, replace(made, said=said))
        if segment.index:
            first.judge(segment, body)
    for job in second_pass.refine_jobs(take, take_shape(take)):
        path = stage.frame_path(job.frame_id, folder="refined")
        stage.ledger.note(path, _put(capture, folder / "second.npz", path, job.frame_id, job.inputs))
        row = {"frame_id": job.frame_id, "verdict": "good", "reasons": [], "unseen": [], "explained": 1.0,
               "median_m": 0.001, "inside": 0.0, "started_from": "motion", "cpu_s": 1.0}  # fmt: skip
        stage.frame_path(job.frame_id, ".json", folder="metrics").write_text(json.dumps(row))
    stage.ledger.settle()


def _put(capture: Capture, source: Path, path: Path, frame_id: int, inputs: Mapping[str, str]) -> Made:
    shutil.copyfile(source, path)
    found, files = path.stat(), _scan(capture, frame_id)
    digest = _digest(str(source))
    return Made({**inputs, "scan": scan_digest(files)}, digest, found.st_size, found.st_mtime_ns, files)


@cache
def _digest(path: str) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def _scan(capture: Capture, frame_id: int) -> tuple[FileState, ...]:
    return as_it_is_now(capture, frame_id, ())


def _paths(capture: Capture, folder: Path) -> Iterator[tuple[int, Path]]:
    return ((frame_id, folder / f"{frame_id:06d}.npz") for frame_id in capture.frame_ids)
