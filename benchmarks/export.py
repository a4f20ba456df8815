"""A long animation handed on in every format: size, time and memory of each, and the error of what has one.

A shirt cut out of the body, each face cut into four, moves with the body on smooth random poses; folds run over it, and
0.1 mm of noise makes no frame a mix of others, as registration's noise does. Each format is exported by a process of
its own. Limits this was built against: 600 MB, 0.001 mm of what keeps positions, of a GLB 0.5 mm at 99 % and 2 mm at
most.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.metric import Metric
from capture4d import pipeline
from capture4d.app.export.config import FORMATS, Format
from capture4d.app.export.stage import possible_formats
from capture4d.body.anny import load_anny
from capture4d.body.skinning import pose_frame, skin, with_shape
from capture4d.captures.work_folder import ANIMATE, stack_vertices
from capture4d.files.atomic import read_json, write_npz
from capture4d.files.records import load_garment, save_body, save_garment, save_poses
from capture4d.geometry.mesh import edges_of_faces, unique_edges
from capture4d.runs.stage import open_stage
from capture4d.templates.config import TemplateConfig
from capture4d.types import Body, Garment, Mesh, PoseSequence

_MOVING = ("spine", "upperarm01", "lowerarm01", "upperleg01", "lowerleg01", "neck01", "head")
_WAVES = 12
_EXPORTED = """
import json, sys, time
from benchmarks.memory import peak_rss_mb
from capture4d.cli.main import main
try:
    main(sys.argv[1:])
except SystemExit as end:
    print(json.dumps({"code": end.code, "peak_mb": peak_rss_mb(), "cpu_s": time.process_time()}))
"""


def run(
    *, quick: bool = False, frames: int = 2000, seed: int = 0, formats: tuple[Format, ...] = FORMATS
) -> list[Metric]:
    """Export an animation.

    Args:
        quick: 60 frames.
        frames: of the animation.
        seed: of poses, folds and noise.
        formats: to export, those whose packages are installed.
    """
    count = 60 if quick else frames
    metrics = [Metric("frames", count, "", "higher")]
    with tempfile.TemporaryDirectory(prefix="capture4d-export-") as scratch:
        work = Path(scratch) / "work"
        _write_work(work, count, seed)
        for kind in possible_formats(formats)[0]:
            output = Path(scratch) / kind
            measured = _exported(work, kind, output)
            told = read_json(output / "export.json")["files"][kind]
            path = output / told["file"]
            files = [path] if path.is_file() else sorted(path.iterdir())
            metrics += [
                Metric(f"{kind}_mb", sum(each.stat().st_size for each in files) / 1e6, "MB"),
                Metric(f"{kind}_cpu_s", measured["cpu_s"], "s"),
                Metric(f"{kind}_peak_mb", measured["peak_mb"], "MB"),
                Metric(f"{kind}_error_max_mm", told["error_mm"], "mm"),
            ]
            if told["fit"] is not None:
                metrics += [
                    Metric(f"{kind}_shapes", told["targets"]),
                    Metric(f"{kind}_error_mean_mm", told["fit"]["mean_mm"], "mm"),
                    Metric(f"{kind}_error_p99_mm", told["fit"]["p99_mm"], "mm"),
                ]
    return metrics


def _exported(work: Path, kind: str, output: Path) -> dict[str, float]:
    command = [sys.executable, "-c", _EXPORTED, "export", work, "--format", kind, "--output", output, "--quiet"]
    done = subprocess.run([str(each) for each in command], capture_output=True, text=True, check=True)
    found = json.loads(done.stdout.splitlines()[-1])
    if found["code"] not in (0, 3):
        raise SystemExit(f"{kind}: {done.stderr}")
    return found


def _write_work(work: Path, frames: int, seed: int) -> None:
    """A work folder as `animate` leaves one."""
    body, rng = load_anny(), np.random.default_rng(seed)
    pipeline.template(None, work / "template.npz", TemplateConfig(region="tshirt"))
    garment = finer(load_garment(work / "template.npz"))
    poses = _poses(body, frames, rng)
    (work / "body").mkdir()
    save_body(work / "body" / "body.npz", body)
    save_poses(work / "body" / "poses.npz", poses)
    stage = open_stage(work / "registration", name=ANIMATE, schema=2, config={}, upstream={})
    save_garment(stage.path / "garment.npz", garment)
    shaped, mesh, weights = with_shape(body, poses.shape), garment.template, garment.skin_weights
    assert weights is not None
    phases, pitches = rng.uniform(0, 6, _WAVES), 12 * rng.standard_normal((_WAVES, 3))
    rates = rng.uniform(0.2, 1.5, _WAVES)
    unknown = np.full(len(mesh.vertices), np.nan, np.float32)
    for row, frame_id in enumerate(poses.frame_ids.tolist()):
        running = mesh.vertices @ pitches.T + phases + 2 * np.pi * rates * row / poses.fps
        folds = 0.003 * np.sin(running) @ np.eye(_WAVES, 3) + 1e-4 * rng.standard_normal(mesh.vertices.shape)
        vertices = skin(mesh.vertices + folds, weights, pose_frame(shaped, poses, row).transforms)
        write_npz(stage.frame_path(frame_id), vertices=vertices.astype(np.float32), residual_m=unknown)
    stack_vertices(stage, poses.frame_ids.tolist())
    stage.finish([stage.path / "vertices.npy"])


def finer(garment: Garment) -> Garment:
    """Each face cut into four at the middles of its sides."""
    mesh, weights = garment.template, garment.skin_weights
    assert weights is not None
    edges = unique_edges(mesh.faces)
    a, b, c = mesh.faces.T
    ab, bc, ca = (len(mesh.vertices) + each for each in edges_of_faces(mesh.faces, edges).T)
    faces = np.stack([np.stack(each, axis=1) for each in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))], axis=1)

    def middles(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values, values[edges].mean(axis=1)]).astype(np.float32)

    uv = None
    if mesh.uv is not None:
        p, q, r = (mesh.uv[:, corner] for corner in range(3))
        pq, qr, rp = (p + q) / 2, (q + r) / 2, (r + p) / 2
        corners = ((p, pq, rp), (pq, q, qr), (rp, qr, r), (pq, qr, rp))
        uv = np.stack([np.stack(each, axis=1) for each in corners], axis=1).reshape(-1, 3, 2).astype(np.float32)
    finer = Mesh(middles(mesh.vertices), faces.reshape(-1, 3).astype(np.int32), uv)
    return Garment(finer, skin_weights=middles(weights), body_shape=garment.body_shape)


def _poses(body: Body, frames: int, rng: np.random.Generator) -> PoseSequence:
    fps, joints = 60.0, len(body.joint_names)
    time, turns = np.arange(frames) / fps, np.zeros((frames, joints, 3))
    for joint, name in enumerate(body.joint_names):
        if name.startswith(_MOVING):
            rates, phases = rng.uniform(0.1, 0.8, 3), rng.uniform(0, 6, 3)
            reach = 0.1 if name.startswith("spine") else 0.5
            turns[:, joint] = reach * np.sin(2 * np.pi * time[:, None] * rates + phases)
    rotations = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix().reshape(frames, joints, 3, 3)
    return PoseSequence(
        rotations.astype(np.float32), np.zeros((frames, 3), np.float32),
        np.zeros(len(body.shape_directions), np.float32), np.arange(1, frames + 1, dtype=np.int32), fps,
        body.joint_names,
    )  # fmt: skip
