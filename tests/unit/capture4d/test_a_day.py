"""A day with a take, command by command: each does again what has changed, and nothing else.

Scans in millimetres with Z up are looked through and put right, a template is made of a mesh, the take is run, stopped,
and run on; then frames come, a scan is replaced, a setting changes. What is counted are the files that a command wrote;
what comes out in the end is that of a run from scratch with the same shape.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import registration.take
from benchmarks.dressed_body import dress_body
from capture4d import pipeline
from capture4d.app.report import take as report_stage
from capture4d.app.status.work_folders import changes
from capture4d.body.anny import load_anny
from capture4d.body.skinning import pose_frame, with_shape
from capture4d.captures.capture import read_capture
from capture4d.files.atomic import read_json, write_json
from capture4d.files.records import save_poses
from capture4d.mesh_files.meshes import write_mesh
from capture4d.motions.retargeting import pose_sequence
from capture4d.types import Mesh
from tests.command_line import fails, run

CLOTH, SUIT = (47, 98, 201), (150, 152, 156)
FIRST, ALL = 4, 9
"""Frames in the morning, and in the evening."""


class Studio:
    """Where scans come from: the built-in body that raises its arm in a shell of cloth, no noise."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        body = load_anny()
        self.person = with_shape(body, np.array([0.6, -0.4], np.float32))
        rotations = np.tile(np.eye(3), (ALL, len(body.joint_names), 1, 1))
        for frame in range(ALL):
            angle = 0.05 * frame
            turn = [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
            rotations[frame, body.joint_names.index("upperarm01.L")] = turn
        poses = pose_sequence(self.person, rotations, 30.0)
        self.poses = replace(poses, frame_ids=np.arange(1, 1 + ALL, dtype=np.int32))

    def scan(self, frame_id: int, *, phase: float | None = None) -> None:
        """Scan a frame: in millimetres, Z up. Another phase is other cloth."""
        dressed = dress_body(
            pose_frame(self.person, self.poses, frame_id - 1), 0.1 * frame_id if phase is None else phase
        )
        bare, cloth = dressed.body, dressed.garment
        vertices = 1000 * np.concatenate([bare.vertices, cloth.vertices])
        mesh = Mesh(
            np.stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]], axis=1),
            np.concatenate([bare.faces, cloth.faces + np.int32(len(bare.vertices))]),
        )
        colours = np.array([SUIT] * len(bare.vertices) + [CLOTH] * len(cloth.vertices), np.uint8)
        write_mesh(self.folder / "scans" / f"{frame_id:06d}.ply", mesh, colours=colours)

    def garment(self, path: Path) -> None:
        """What the subject wears, on the mean body in its rest pose, as an obj in metres."""
        rest = with_shape(load_anny(), np.zeros(2, np.float32))
        poses = pose_sequence(rest, np.tile(np.eye(3), (1, len(rest.body.joint_names), 1, 1)), 30.0)
        write_mesh(path, dress_body(pose_frame(rest, poses, 0), 0.0).garment)


@dataclass(frozen=True)
class Done:
    """Files that a command wrote."""

    extracted: int = 0
    tracked: int = 0
    """In the first pass, ..."""
    refined: int = 0
    """... and in the second."""
    registered: int = 0
    drawn: bool = False
    """Frames of the report; how many, their verdicts say."""


class Watch:
    """Counts the files that commands write."""

    folders: Mapping[str, str] = {
        "extracted": "garment/frames", "tracked": "body/frames", "refined": "body/refined",
        "registered": "registration/frames",
    }  # fmt: skip

    def __init__(self, work: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.work, self.drawn = work, False
        plain = report_stage._draw_row

        def counted(*arguments):
            self.drawn = True
            return plain(*arguments)

        monkeypatch.setattr(report_stage, "_draw_row", counted)
        self.before = self._times()

    def _times(self) -> dict[Path, int]:
        return {path: path.stat().st_mtime_ns for path in self.work.rglob("*.npz")}

    def done(self) -> Done:
        """What has been written since this was asked last."""
        now, before, drawn = self._times(), self.before, self.drawn
        self.before, self.drawn = now, False
        new = [path.parent.relative_to(self.work).as_posix() for path in now if now[path] != before.get(path)]
        return Done(**{name: new.count(folder) for name, folder in self.folders.items()}, drawn=drawn)


def stop_after(frames: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C while the next frame is registered."""
    plain, count = registration.take._make_frame, 0

    def make(*arguments):
        nonlocal count
        if count == frames:
            raise KeyboardInterrupt
        count += 1
        plain(*arguments)

    monkeypatch.setattr(registration.take, "_make_frame", make)


@pytest.mark.slow
def test_a_day(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    raw, take, work = tmp_path / "take", tmp_path / "take-fixed", tmp_path / "work"
    studio = Studio(raw)
    for frame_id in range(1, 1 + FIRST):
        studio.scan(frame_id)
    write_json(raw / "capture.json", {"format": 1, "fps": 30, "units": "mm", "garment_colour": "#2f62c9"})
    save_poses(tmp_path / "start.npz", studio.poses)
    studio.garment(tmp_path / "shirt.obj")

    assert run("check", raw, "--fix", "--workers", "1") == 3, "what was handed in has its Z up"
    assert run("template", tmp_path / "shirt.obj", "--output", take / "template.npz") == 0
    command = ["run", take, "--output", work, "--workers", "1", "--tracking.start", tmp_path / "start.npz"]
    command += ["--registration.graph.nodes", "20"]
    watch = Watch(work, monkeypatch)

    with monkeypatch.context() as patched:
        stop_after(2, patched)
        said = fails(capsys, *command, code=130)
    assert said == "interrupted; finished frames are kept, the same command goes on"
    assert watch.done() == Done(extracted=4, tracked=4, refined=4, registered=2)

    assert run(*command) == 0
    assert watch.done() == Done(registered=2, drawn=True)
    assert run(*command) == 0
    assert watch.done() == Done(), "nothing is left to do"

    for frame_id in range(1 + FIRST, 1 + ALL):
        studio.scan(frame_id)
    grow(raw, take)
    capsys.readouterr()
    extracting, tracking, _ = changes(take, work, tracking=tracking_config(tmp_path))
    assert extracting.inputs == ("5 frames added (5-9)",)
    assert (extracting.pending, tracking.pending) == ((5, 6, 7, 8, 9), (5, 6, 7, 8, 9))
    assert tracking.kept == ("shape, found from frames 1-4",)
    assert run(*command) == 0
    said = capsys.readouterr().err
    assert "garment: 5 frames added (5-9)" in said
    assert "body: the shape of the take stays as frames 1-4 gave it; --renew shape finds it anew" in said
    # the fourth frame has a neighbour on both sides now
    assert watch.done() == Done(extracted=5, tracked=5, refined=6, registered=6, drawn=True)

    studio.scan(8, phase=4.0)
    grow(raw, take)
    capsys.readouterr()
    assert run(*command) == 0
    assert "garment: frame 8 replaced" in capsys.readouterr().err
    # tracked on from there; the seventh frame has another neighbour
    assert watch.done() == Done(extracted=1, tracked=2, refined=3, registered=3, drawn=True)

    shutil.copytree(work, tmp_path / "before")
    changed = [*command, "--registration.sequence.relax", "0.5"]
    said = fails(capsys, *changed)
    assert "registration: was made with other settings (relax 0.4 to 0.5); with --overwrite the same command" in said
    assert watch.done() == Done()
    with monkeypatch.context() as patched:
        stop_after(3, patched)
        said = fails(capsys, *changed, "--overwrite", code=130)
    assert said == (
        "interrupted; finished frames are kept; without --overwrite the same command goes on, with it it begins anew"
    )
    assert watch.done() == Done(registered=3)
    assert run(*changed) == 0
    assert watch.done() == Done(registered=6, drawn=True)

    capsys.readouterr()
    assert run("diff", tmp_path / "before", work) == 0
    (line,) = (line for line in capsys.readouterr().out.splitlines() if "relax" in line)
    assert "0.4" in line
    assert "0.5" in line
    assert watch.done() == Done(), "a comparison writes its page alone"

    scratch = tmp_path / "scratch"
    pipeline.take_over(scratch, work)
    monkeypatch.undo()
    assert run(*(scratch if each == work else each for each in changed)) == 0
    for stage in ("garment", "body", "registration"):
        digests = [read_json(folder / stage / "stage.json")["digest"] for folder in (work, scratch)]
        assert digests[0] == digests[1], stage


def tracking_config(folder: Path):
    from capture4d.tracking.config import TrackingConfig

    return TrackingConfig(start=str(folder / "start.npz"))


def grow(raw: Path, take: Path) -> None:
    """Put the take right anew, all of it: scans that come out as they were are no change."""
    shutil.copy(take / "template.npz", raw.parent / "kept.npz")
    shutil.rmtree(take)
    assert run("check", raw, "--fix", "--workers", "1") == 3
    shutil.copy(raw.parent / "kept.npz", take / "template.npz")
    assert read_capture(take).frame_ids
