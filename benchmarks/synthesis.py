"""The synthetic scanner: is the cloth cloth, are the scans scans, and what do they cost?

Two fabrics, bodies and motions, arms from hanging to overhead. Limits this benchmark was built against: wrinkle
residual at least 7 deg, determinism ratio at most 0.5, flicker at most 1.3, 99 % of edges within 1.15 of their length
(1.2 with arms overhead), at most 0.1 % of the vertices inside the body, hem within 10 mm of the cloth solved four times
as hard (in the first 40 frames alone), at most 2.5 and 4.5 CPU seconds a frame (mean of the takes; a take beside which
another one is simulated on the same core costs up to a quarter more), scans of about 200,000 vertices within 0.2 mm
and 4 deg of the truth.

Folds: ninth decile of their turn at least 2.6 times the median, calm area 20 to 35 %, height 2.6 to 3.9 mm, in the mean
of four poses and none of them below .85 of it; first percentile of the least stretch at least .97, at most 325 fine
faces that cut others. Trousers (`--data trousers`) have the same limits on thigh and shin, at four moments of a walk
and of a squat.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from rich.console import Console

from benchmarks.fold_statistics import fold_statistics, legs, torso
from benchmarks.metric import Metric
from benchmarks.scan_errors import scan_errors
from capture4d.body.skinning import PosedBody, ShapedBody
from capture4d.geometry.mesh import vertex_normals
from capture4d.geometry.triangles import count_intersecting_faces
from capture4d.runs.workers import run_jobs
from capture4d.types import Mesh
from data_synth.cloth.fabrics import FABRICS
from data_synth.cloth.patterns import locate
from data_synth.cloth.quality import measure_cloth, principal_stretches
from data_synth.cloth.simulation import simulate
from data_synth.cloth.wrinkle_relaxation import lift_levels, relax_levels
from data_synth.config import OTHER_BODIES, PRESETS, MotionConfig, SynthConfig
from data_synth.scanner.scan import LABEL_BODY, scan_surfaces
from data_synth.stage import run as synthesise
from data_synth.take import TakePlan, in_view, plan_take, simulate_take, take_rig, take_surfaces
from data_synth.worn import is_held_at_waist, put_on

Clothes = Literal["shirts", "trousers"]

POSES = ("rest", "hanging", "half", "overhead")
MOMENTS = ("start", "third", "two_thirds", "end")
"""Of a clip, at which trousers are looked at."""
FOLD_UNITS = {"fold_p90_to_median": "", "calm_percent": "%", "fold_height_rms_mm": "mm", "compression_p1": ""}
"""Means over the poses, each of them, and the least of any take; compression is the first percentile of the least
stretch of any face."""
OVERHEAD_COSINE = 0.5
"""An upper arm that points up steeper than this is overhead."""


@dataclass(frozen=True, slots=True)
class _Job:
    config: SynthConfig
    scan_every: int
    converge_frames: int
    late_start: int | None


def run(
    *, quick: bool = False, frames: int = 120, every: int = 1, data: Clothes = "shirts", workers: int = 2
) -> list[Metric]:
    """Simulate and scan takes of two fabrics, on two bodies in two motions.

    Args:
        quick: small takes of 14 frames, the same keys.
        frames: frames of each take.
        every: simulated frames to a captured one.
        data: what is worn.
    """
    rows = []
    jobs = _jobs(frames, every, data, quick=quick)
    for config, row in run_jobs(_measure, jobs, workers=workers, label="Synthetic takes"):
        numbers = ", ".join(f"{key} {value:.4g}" for key, value in row.items())
        Console(stderr=True).print(f"{config.fabric}, seed {config.seed}: {numbers}", soft_wrap=True)
        rows.append(row)
    with tempfile.TemporaryDirectory(prefix="capture4d-synthesis-") as scratch:
        preset = PRESETS["trousers-demo" if data == "trousers" else "tiny"]
        tiny = replace(preset, frames=2, capture_every=2, scans=data == "shirts")
        digests = {synthesise(Path(scratch) / str(count), tiny, workers=count).digest for count in (1, 2)}

    def mean(key: str) -> float:
        return float(np.mean([row[key] for row in rows if key in row]))

    def worst(key: str) -> float:
        return float(np.max([row[key] for row in rows if key in row]))

    def least(key: str) -> float:
        return float(np.min([row[key] for row in rows if key in row]))

    return [
        Metric("fine_vertices", least("fine_vertices"), "", "higher"),
        Metric("wrinkle_residual_deg", least("wrinkle_residual_deg"), "deg", "higher"),
        Metric("pose_determinism_ratio", worst("pose_determinism_ratio")),
        Metric("fold_determinism_ratio", worst("fold_determinism_ratio")),
        Metric("flicker_ratio", worst("flicker_ratio")),
        Metric("stretch_p99", worst("stretch_p99")),
        Metric("stretch_p99_overhead", worst("stretch_p99_overhead")),
        Metric("inside_body_percent", worst("inside_body_percent"), "%"),
        Metric("inside_body_worst_frame_percent", worst("inside_body_worst_frame_percent"), "%"),
        Metric("flagged_frames", float(sum(row["flagged_frames"] for row in rows))),
        Metric("hem_sag_mm", worst("hem_sag_mm"), "mm"),
        Metric("self_intersecting_faces", mean("self_intersecting_faces")),
        Metric("self_intersecting_fine_faces", mean("self_intersecting_fine_faces")),
        Metric("sim_cpu_s", mean("sim_cpu_s"), "s/frame"),
        Metric("sim_cpu_worst_take_s", worst("sim_cpu_s"), "s/frame"),
        Metric("scan_cpu_s", mean("scan_cpu_s"), "s/frame"),
        Metric("scan_cpu_worst_take_s", worst("scan_cpu_s"), "s/frame"),
        Metric("scan_vertices", mean("scan_vertices"), "", "higher"),
        Metric("scan_vertices_least", least("scan_vertices_least"), "", "higher"),
        Metric("scan_vertices_most", worst("scan_vertices_most")),
        Metric("scan_accuracy_median_mm", worst("scan_accuracy_median_mm"), "mm"),
        Metric("scan_normal_deg", worst("scan_normal_deg"), "deg"),
        Metric("hole_percent", mean("hole_percent"), "%"),
        Metric("hole_percent_least", least("hole_percent_least"), "%", "higher"),
        Metric("hole_percent_most", worst("hole_percent_most"), "%"),
        Metric("same_seed_same_digest", float(len(digests) == 1), "", "higher"),
        *(
            Metric(name, mean(name), FOLD_UNITS[key], "lower" if key == "calm_percent" else "higher")
            for key in FOLD_UNITS
            for name in (key, *(f"{key}_{pose}" for pose in (MOMENTS if data == "trousers" else POSES)))
        ),
        *(Metric(f"{key}_least", least(f"{key}_least"), unit, "higher") for key, unit in FOLD_UNITS.items()),
    ]


def _jobs(frames: int, every: int, data: Clothes, *, quick: bool) -> list[_Job]:
    if quick:
        # Sampled as finely as the folds' limits are stated for.
        if data == "trousers":
            small = replace(PRESETS["trousers-demo"], template_vertices=5000)
            return [_Job(small, scan_every=7, converge_frames=10, late_start=4)]
        small = replace(PRESETS["tiny"], frames=14, capture_every=4, template_vertices=5000)  # up to arms overhead
        return [
            _Job(small, scan_every=7, converge_frames=10, late_start=4),
            _Job(_other(small, seed=1), scan_every=7, converge_frames=0, late_start=None),
        ]
    if data == "trousers":
        base = replace(PRESETS["trousers-200k"], frames=frames, capture_every=every)
        takes = [
            replace(base, motion=MotionConfig("walk")),
            replace(base, fabric="denim", seed=1, body_shape=OTHER_BODIES["heavy"], motion=MotionConfig("squat")),
        ]
    else:
        base = replace(PRESETS["tshirt-200k"], frames=frames, capture_every=every)
        takes = [
            base,
            replace(base, fabric="shirt-cotton", seed=1, body_shape=OTHER_BODIES["heavy"]),
            replace(base, fabric="shirt-cotton", seed=2, motion=MotionConfig("arm-circles")),
        ]
    return [
        _Job(
            take,
            scan_every=max(1, frames // 8),
            converge_frames=40 if take.seed == 0 else 0,
            late_start=frames // 3 if take.seed == 0 else None,
        )
        for take in takes
    ]


def _other(take: SynthConfig, *, seed: int) -> SynthConfig:
    """The same on somebody else, in another fabric and motion."""
    return replace(
        take,
        fabric="shirt-cotton",
        seed=seed,
        body_shape=OTHER_BODIES["heavy"],
        motion=MotionConfig("arm-circles"),
    )


def _measure(job: _Job) -> tuple[SynthConfig, dict[str, float]]:
    take = plan_take(job.config)
    faces = take.shaped.body.template.faces
    started = time.process_time()
    clip = [(index, coarse, fine) for index, coarse, fine in simulate_take(take) if fine is not None]
    sim_cpu = time.process_time() - started
    residuals, flickers, normals = _wrinkles(take, clip)
    qualities = [
        measure_cloth(take.fine, take.wrinkles, fine, take.bodies[take.lead + index].vertices(), faces)
        for index, _, fine in clip
    ]
    overhead = np.array(
        [arms_up(take.shaped, take.bodies[take.lead + index]) > OVERHEAD_COSINE for index, _, _ in clip]
    )
    stretch = np.array([quality.stretch_p99 for quality in qualities])
    inside = np.array([quality.inside_body_percent for quality in qualities])
    row = {
        "fine_vertices": take.fine.vertex_count,
        "wrinkle_residual_deg": residuals.mean(),
        "flicker_ratio": flickers[:, 0].mean() / flickers[:, 1].mean(),
        "stretch_p99": stretch[~overhead].max(initial=0),
        "stretch_p99_overhead": stretch[overhead].max(initial=0),
        "inside_body_percent": inside.mean(),
        "inside_body_worst_frame_percent": inside.max(),
        "flagged_frames": sum(bool(quality.reasons) for quality in qualities),
        "self_intersecting_faces": np.mean(
            [count_intersecting_faces(coarse, take.coarse.faces) for _, coarse, _ in clip[:: job.scan_every]]
        ),
        "self_intersecting_fine_faces": np.mean(
            [count_intersecting_faces(fine.astype(float), take.fine.faces) for _, _, fine in clip[:: job.scan_every]]
        ),
        "sim_cpu_s": sim_cpu / len(clip),
        **_folds(take, clip),
        **_scans(take, clip[job.scan_every // 2 :: job.scan_every]),
    }
    if job.late_start is not None:
        row["fold_determinism_ratio"] = _fold_determinism(job, take, clip, normals) / residuals.mean()
        row["pose_determinism_ratio"] = _determinism(job, normals) / residuals.mean()
    if job.converge_frames:
        row["hem_sag_mm"] = _hem_sag(take, clip, job.converge_frames)
    return job.config, {key: float(value) for key, value in row.items()}


def _angles(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip(np.einsum("vc,vc->v", first, second), -1, 1)))


def _wrinkles(take: TakePlan, clip: list) -> tuple[np.ndarray, np.ndarray, dict[int, np.ndarray]]:
    """Per frame: what a template at the truth cannot show, deg; and how fine and coarse normals change, deg."""
    to_fine, fine_weights = locate(take.fine, take.template.vertex_uv)
    to_template, template_weights = locate(take.template, take.fine.vertex_uv)
    residuals, changes, normals = [], [], {}
    before = None
    for index, coarse, fine in clip:
        normal = vertex_normals(fine.astype(float), take.fine.faces)
        placed = np.einsum("vk,vkc->vc", fine_weights, fine[take.fine.faces[to_fine]])
        flat = vertex_normals(placed, take.template.faces)[take.template.faces[to_template]]
        flat = np.einsum("vk,vkc->vc", template_weights, flat)
        residuals.append(_angles(normal, flat / np.linalg.norm(flat, axis=1, keepdims=True)).mean())
        smooth = lift_levels(take.levels, coarse)[1]
        if before is not None:
            changes.append((_angles(normal, before[0]).mean(), _angles(smooth, before[1]).mean()))
        before = normal, smooth
        normals[index] = normal
    return np.array(residuals), np.array(changes), normals


def arms_up(shaped: ShapedBody, posed: PosedBody) -> float:
    """How steeply the higher upper arm points up: 1 is overhead, 0 level, -1 hanging."""
    names, joints = shaped.body.joint_names, shaped.joints
    up = []
    for side in "LR":
        shoulder, elbow = names.index(f"upperarm01.{side}"), names.index(f"lowerarm01.{side}")
        arm = posed.transforms[shoulder, :3, :3] @ (joints[elbow] - joints[shoulder])
        up.append(float(arm[1] / np.linalg.norm(arm)))
    return max(up)


def _folds(take: TakePlan, clip: list) -> dict[str, float]:
    """Statistics of the trunk's folds, and compression of the fine cloth in its plane, in four poses of the arms; of
    trousers those of thigh and shin, at four moments."""
    looked_at = _moments(clip) if is_held_at_waist(take.config) else _poses(take, clip)
    to_fine, weights = locate(take.fine, take.template.vertex_uv)
    row: dict[str, float] = {}
    for pose, position in looked_at.items():
        fine = clip[position][2].astype(np.float64)
        placed = np.einsum("vk,vkc->vc", weights, fine[take.fine.faces[to_fine]])
        chosen = legs(take.template, take.pattern) if is_held_at_waist(take.config) else torso(placed)
        folds = fold_statistics(placed, take.template.faces, chosen)
        row[f"fold_p90_to_median_{pose}"] = folds.p90_to_median
        row[f"calm_percent_{pose}"] = folds.calm_percent
        row[f"fold_height_rms_mm_{pose}"] = folds.height_rms_mm
        row[f"compression_p1_{pose}"] = float(np.percentile(principal_stretches(take.fine, fine)[:, 0], 1))
    for key in FOLD_UNITS:
        each = [row[f"{key}_{pose}"] for pose in looked_at]
        row[key], row[f"{key}_least"] = float(np.mean(each)), min(each)
    return row


def _poses(take: TakePlan, clip: list) -> dict[str, int]:
    """Where in a clip the arms are in each of `POSES`."""
    up = np.array([arms_up(take.shaped, take.bodies[take.lead + index]) for index, _, _ in clip])
    hanging = int(np.argmin(up))
    overhead = hanging + int(np.argmax(up[hanging:]))
    level = hanging + int(np.argmin(np.abs(up[hanging : overhead + 1])))
    return dict(zip(POSES, (0, hanging, level, overhead), strict=True))


def _moments(clip: list) -> dict[str, int]:
    return dict(zip(MOMENTS, np.linspace(0, len(clip) - 1, len(MOMENTS)).astype(int).tolist(), strict=True))


def _determinism(job: _Job, normals: dict[int, np.ndarray]) -> float:
    """Mean angle, deg, to a second simulation, dressed anew, that joins the clip a third of the way in."""
    assert job.late_start is not None
    take = plan_take(job.config)
    first = job.late_start * job.config.capture_every
    later = plan_take(
        replace(
            job.config,
            frames=job.config.frames - job.late_start,
            motion=replace(job.config.motion, skip_frames=first),
        )
    )
    assert np.array_equal(later.fine.faces, take.fine.faces)
    compared = []
    for index, _, fine in simulate_take(later):
        if fine is not None and index + first > first + (max(normals) - first) // 2:
            compared.append(_angles(vertex_normals(fine.astype(float), take.fine.faces), normals[index + first]).mean())
    return float(np.mean(compared))


def _fold_determinism(job: _Job, take: TakePlan, clip: list, normals: dict[int, np.ndarray]) -> float:
    """Mean angle, deg, to folds on the same coarse cloth that start anew a third of the way into the clip."""
    assert job.late_start is not None
    offsets, compared = None, []
    late = clip[job.late_start :]
    for index, coarse, _ in late:
        fine, offsets = relax_levels(take.levels, coarse, take.bodies[take.lead + index], offsets)
        if index > (late[0][0] + late[-1][0]) // 2:
            compared.append(_angles(vertex_normals(fine.astype(float), take.fine.faces), normals[index]).mean())
    return float(np.mean(compared))


def _hem_sag(take: TakePlan, clip: list, frames: int) -> float:
    """How much lower the hem hangs than in the same cloth solved with four times the iterations, mm, largest frame.

    Only the first `frames` simulated frames of the clip are compared: 0 to 39 in the whole benchmark, while the arms go
    from the rest pose to hanging and begin to rise; 0 to 9 in the quick one.
    """
    harder = replace(take.config.simulation, iterations=4 * take.config.simulation.iterations)
    worn = put_on(take.config, take.shaped, take.coarse, take.pattern, take.bodies[0])
    stop = take.lead + frames
    fabric = FABRICS[take.config.fabric]
    hem = np.concatenate([rows for name, rows in take.coarse.loops.items() if name.startswith(("hem", "leg"))])
    usual = {index: coarse for index, coarse, _ in clip}
    sags = [
        usual[step - take.lead][hem, 1].mean() - coarse[hem, 1].mean()
        for step, coarse in enumerate(
            simulate(
                take.coarse,
                worn.vertices,
                take.bodies[:stop],
                fabric,
                harder,
                made=take.made,
                held_from=worn.held_from,
            )
        )
        if step - take.lead in usual
    ]
    return 1e3 * float(np.abs(sags).max())


def _scans(take: TakePlan, clip: list) -> dict[str, float]:
    extent = np.array(
        [in_view(take.config, fine, take.bodies[take.lead + index].vertices()) for index, _, fine in clip]
    )
    rig = take_rig(take.config, extent)
    vertices, accuracy, angles, holes, cpu = [], [], [], [], 0.0
    for index, _, fine in clip:
        surface = take.bodies[take.lead + index].vertices().astype(np.float32)
        truth = Mesh(fine, take.fine.faces)
        started = time.process_time()
        scan, labels = scan_surfaces(
            rig,
            take_surfaces(take, fine, surface),
            config=take.config.scanner,
            rng=np.random.default_rng([take.config.seed, index]),
        )
        cpu += time.process_time() - started
        garment = (labels != LABEL_BODY)[scan.mesh.faces].all(axis=1)
        used, faces = np.unique(scan.mesh.faces[garment], return_inverse=True)
        part = Mesh(scan.mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32))
        errors = scan_errors(part, truth)
        vertices.append(len(scan.mesh.vertices))
        accuracy.append(1e3 * np.median(errors.distance_m))
        angles.append(errors.normal_deg.mean())
        holes.append(100 * errors.hole_share)
    row = {
        "scan_cpu_s": cpu / len(clip),
        "scan_vertices": np.mean(vertices),
        "scan_vertices_least": np.min(vertices),
        "scan_vertices_most": np.max(vertices),
        "scan_accuracy_median_mm": np.mean(accuracy),
        "scan_normal_deg": np.mean(angles),
        "hole_percent": np.mean(holes),
        "hole_percent_least": np.min(holes),
        "hole_percent_most": np.max(holes),
    }
    return {key: float(value) for key, value in row.items()}
