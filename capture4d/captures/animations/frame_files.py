"""An animation's frames as files: what each is judged by, and how they come together as a registered sequence.

registration/frames/000123.npz    vertices, residuals that are NaN, the verdict
registration/metrics/000123.json  what the verdict goes by; written first
registration/vertices.npy metrics.jsonl   all of them
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from capture4d.captures.work_folder import ANIMATE, VERDICTS, stack_vertices
from capture4d.files.atomic import read_json, write_json, write_json_lines, write_npz
from capture4d.geometry.intersection_removal import Removed
from capture4d.runs.stage import Stage, StageResult, open_stage
from capture4d.types import PoseSequence

__all__ = ["FRAMES_AT_ONCE", "AnimatedFrame", "FrameFiles", "collect", "motion_files", "open_frames", "write_frame"]

SCHEMA = 2
"""Of an animation's output."""
INSIDE_CHECK_PERCENT = 0.3
"""A frame with more of its vertices inside the body, after all, is flagged."""
STRETCH_CHECK, STRETCH_FAIL = 1.4, 2.5
"""A frame with edges so much longer than the template's, 99th percentile, is flagged, or has failed: cloth does not
stretch like that. The limits are registration's (`quality.stretch_check`, `quality.stretch_fail`)."""
FLIPPED_CHECK_PERCENT = 1.0
"""A frame with more of its faces turned against the body is flagged (registration's `quality.flipped_check_percent`,
which goes by the scan)."""


FRAMES_AT_ONCE = 16
"""More take more memory; another number, too, changes the last bits of matrix products."""


@dataclass(frozen=True, slots=True, eq=False)
class AnimatedFrame:
    """The garment in one frame."""

    vertices: Float32[np.ndarray, "verts 3"]
    """Metres, world."""
    removed: Removed
    stretch_p99: float
    """Edge length over that of the cloth on this person, 99th percentile."""


def open_frames(
    output: Path,
    config: Mapping[str, Any],
    upstream: Mapping[str, str],
    sources: Mapping[str, Path],
    *,
    overwrite: bool,
) -> Stage:
    """The stage of an animation's frames, which is that of a registration."""
    return open_stage(
        output / "registration",
        name=ANIMATE,
        schema=SCHEMA,
        config=config,
        upstream=upstream,
        sources=sources,
        overwrite=overwrite,
    )


@dataclass(frozen=True, slots=True, eq=False)
class FrameFiles:
    """Where frames are written, and what they are judged by."""

    stage: Stage
    poses: PoseSequence
    distances_deg: Float64[np.ndarray, " frames"]
    """To the nearest pose that was learned."""
    unlike_deg: float


def motion_files(output: Path) -> tuple[Path, Path]:
    """Who moves, and how."""
    return output / "body" / "body.npz", output / "body" / "poses.npz"


def write_frame(shared: FrameFiles, row: int, frame: AnimatedFrame) -> None:
    """Metrics first: the frame counts as done once its npz is there."""
    stage, removed = shared.stage, frame.removed
    flipped_percent = 100.0 * float(removed.flipped.mean()) if len(removed.flipped) else 0.0
    frame_id, distance_deg = int(shared.poses.frame_ids[row]), float(shared.distances_deg[row])
    reasons = []
    torn = not frame.stretch_p99 <= STRETCH_FAIL
    if not frame.stretch_p99 <= STRETCH_CHECK:
        limit = STRETCH_FAIL if torn else STRETCH_CHECK
        reasons.append(f"edges {frame.stretch_p99:.3g} times as long as the cloth's > {limit:g}")
    if distance_deg > shared.unlike_deg:
        reasons.append(f"pose {distance_deg:.0f} deg from every pose that was learned > {shared.unlike_deg:.0f}")
    if removed.after.inside_percent > INSIDE_CHECK_PERCENT:
        reasons.append(f"inside the body {removed.after.inside_percent:.2f} % > {INSIDE_CHECK_PERCENT:g} %")
    if flipped_percent > FLIPPED_CHECK_PERCENT:
        reasons.append(f"faces turned against the body {flipped_percent:.2f} % > {FLIPPED_CHECK_PERCENT:g} %")
    record: dict[str, Any] = {
        "frame_id": frame_id,
        "verdict": "failed" if torn else "check" if reasons else "good",
        "reasons": reasons,
        "pose_distance_deg": distance_deg,
        "unlike_deg": shared.unlike_deg,
        "inside_before_percent": removed.before.inside_percent,
        "depth_before_mm": removed.before.depth_max_mm,
        "inside_body_percent": removed.after.inside_percent,
        "depth_mm": removed.after.depth_max_mm,
        "overlap_percent": removed.after.overlap_percent,
        "removal_moved_mm": removed.rest_moved_mm,
        "stretch_p99": frame.stretch_p99,
        "flipped_faces": int(removed.flipped.sum()),
    }
    write_json(stage.frame_path(frame_id, ".json", folder="metrics"), record)
    write_npz(
        stage.frame_path(frame_id),
        vertices=frame.vertices,
        residual_m=np.full(len(frame.vertices), np.nan, np.float32),
        verdict=np.uint8(VERDICTS.index(record["verdict"])),
    )


def collect(stage: Stage, frame_ids: Sequence[int]) -> StageResult:
    """All frames as one registered sequence; `failed` are those whose cloth is torn."""
    stack_vertices(stage, frame_ids)
    records = [read_json(stage.frame_path(frame_id, ".json", folder="metrics")) for frame_id in frame_ids]
    write_json_lines(stage.path / "metrics.jsonl", records)
    frames = [stage.frame_path(frame_id) for frame_id in frame_ids]
    outputs = [stage.path / "garment.npz", stage.path / "vertices.npy", *frames]
    failed = {each["frame_id"]: "; ".join(each["reasons"]) for each in records if each["verdict"] == "failed"}
    return stage.finish(outputs, frames=len(frame_ids), failed=failed)
