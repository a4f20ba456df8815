"""Work folders of synthetic takes as if they had been tracked and registered without any error: cheap, and fair to what
is learned from them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.learning_takes import true_take
from capture4d.captures.capture import Capture
from capture4d.captures.work_folder import REGISTER, VERDICTS, stack_vertices
from capture4d.files.atomic import write_json_lines, write_npz
from capture4d.files.records import save_body, save_garment, save_poses
from capture4d.runs.stage import open_stage

__all__ = ["write_true_work"]


def write_true_work(capture: Capture, work: Path) -> Path:
    """Write body/ and registration/ of a take from its truth, over what is there.

    Args:
        work: the work folder.
    """
    registered, person, poses, _ = true_take(capture)
    tracked = open_stage(work / "body", name="track", schema=1, config={}, upstream={}, overwrite=True)
    save_body(tracked.path / "body.npz", person.body)
    save_poses(tracked.path / "poses.npz", poses)
    digest = tracked.finish([tracked.path / "body.npz", tracked.path / "poses.npz"]).digest
    upstream = {"body": digest, "garment": capture.name}
    stage = open_stage(work / "registration", name=REGISTER, schema=1, config={}, upstream=upstream, overwrite=True)
    save_garment(stage.path / "garment.npz", registered.garment)
    frame_ids = [int(frame_id) for frame_id in registered.frame_ids]
    for row, frame_id in enumerate(frame_ids):
        vertices, residual = np.asarray(registered.vertices[row], np.float32), registered.residual_m[row]
        write_npz(stage.frame_path(frame_id), vertices=vertices, residual_m=residual, verdict=np.uint8(0))
    stack_vertices(stage, frame_ids)
    records = [{"frame_id": frame_id, "verdict": VERDICTS[0], "reasons": []} for frame_id in frame_ids]
    write_json_lines(stage.path / "metrics.jsonl", records)
    stage.finish([stage.path / name for name in ("garment.npz", "vertices.npy", "metrics.jsonl")])
    return work
