"""High-resolution normal maps from scans, against the true normals of the simulated garment.

Low maps are those of the registered template, not of its true positions. Limits this was built against: `high_map_deg`
2.5 over valid texels, `valid_percent` 90 of the garment that a camera sees, `recovered_energy` 0.65 where the low map
errs by 6 deg or more, `pair_cpu_s` 1.

There are two truths. A map shows the surface where the registered template lies: against the true surface there, it
says how well scans are read. `_material` compares with the piece of cloth that ought to lie there: it also holds the
millimetres by which registration slides along the cloth, which at folds of 20 mm are degrees.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.metric import Metric
from benchmarks.registered_work import QUICK_TAKE, locate_texels, registered_work
from capture4d.body.skinning import pose_frame, with_shape
from capture4d.captures.capture import Capture, read_capture
from capture4d.captures.garment_scans import load_garment_scan
from capture4d.captures.truth import read_truth_frame, read_truth_model
from capture4d.captures.work_folder import load_registration
from capture4d.files.records import load_poses, load_rig
from capture4d.geometry.mesh import normalised, vertex_normals
from capture4d.geometry.ray_casting import TriangleScene, barycentric
from capture4d.geometry.uv_layout import millimetres_per_texel
from capture4d.types import Mesh
from data_synth.config import PRESETS
from wrinkles.normal_maps.config import PairConfig
from wrinkles.normal_maps.template import FramePair, MapTemplate, frame_pairs

TAKES = ("tshirt-200k", "tshirt-cotton-200k")
RUN = 6
"""Frames in a row, as a take is processed: a scan serves its own frame and both neighbours."""
SIGNAL_DEG, QUICK_SIGNAL_DEG = 6.0, 2.0
RAY_STEP = 4
"""Every so many texels are asked which camera sees them."""
REACH_M = 0.02


@dataclass(frozen=True, slots=True)
class _Row:
    signal_deg: float
    high_deg: float
    valid_percent: float
    residual: float
    """Sum of squares of high minus truth."""
    signal: float
    """Sum of squares of low minus truth."""
    slid_mm: float
    """Mean distance of the texels from their material points, along the surface."""


def run(*, quick: bool = False, frames: int = 24, workers: int = 2) -> list[Metric]:
    """Measure pairs of two takes.

    Args:
        quick: six frames of a small take with a coarse scanner, the same keys.
        frames: of each take.
    """
    rows: list[_Row] = []
    material: list[_Row] = []
    cpu_s, mm_per_texel = [], []
    for config in (QUICK_TAKE,) if quick else tuple(PRESETS[name] for name in TAKES):
        capture, work = registered_work(config, workers=workers)
        measured, seconds, millimetres = _measure(capture, work, RUN if quick else frames)
        rows += [row for row, _ in measured]
        material += [row for _, row in measured]
        cpu_s.append(seconds)
        mm_per_texel.append(millimetres)
    signal = QUICK_SIGNAL_DEG if quick else SIGNAL_DEG  # coarse cloth hardly wrinkles
    strong = [row for row in rows if row.signal_deg >= signal]
    return [
        Metric("high_map_deg", float(np.mean([row.high_deg for row in rows])), "deg"),
        Metric("low_map_deg", float(np.mean([row.signal_deg for row in rows])), "deg", "higher"),
        Metric("valid_percent", float(np.mean([row.valid_percent for row in rows])), "%", "higher"),
        Metric("valid_percent_worst", min(row.valid_percent for row in rows), "%", "higher"),
        Metric("recovered_energy", _recovered(strong), "", "higher"),
        Metric("high_map_material_deg", float(np.mean([row.high_deg for row in material])), "deg"),
        Metric("low_map_material_deg", float(np.mean([row.signal_deg for row in material])), "deg", "higher"),
        Metric(
            "recovered_energy_material",
            _recovered([row for row in material if row.signal_deg >= signal]),
            "",
            "higher",
        ),
        Metric("slid_mm", float(np.mean([row.slid_mm for row in material])), "mm"),
        Metric("strong_frames", float(len(strong)), "frames", "higher"),
        Metric("frames", float(len(rows)), "frames", "higher"),
        Metric("pair_cpu_s", float(np.mean(cpu_s)), "s"),
        Metric("mm_per_texel", float(np.mean(mm_per_texel)), "mm"),
    ]


def _recovered(rows: Sequence[_Row]) -> float:
    return 1 - sum(row.residual for row in rows) / sum(row.signal for row in rows) if rows else float("nan")


def _measure(capture_folder: Path, work: Path, frames: int) -> tuple[list[tuple[_Row, _Row]], float, float]:
    capture, sequence = read_capture(capture_folder), load_registration(work / "registration")
    config = PairConfig()
    template = MapTemplate.create(sequence.garment, config.map)
    model = read_truth_model(capture)
    assert model is not None
    assert model.fine.uv is not None
    assert sequence.garment.template.uv is not None
    texel_uv = template.raster.at_corners(sequence.garment.template.uv)
    faces, weights = locate_texels(texel_uv, model.fine.uv)
    corners = model.fine.faces[faces]
    ids = sequence.frame_ids.tolist()
    starts = np.linspace(0, len(ids) - RUN, max(frames // RUN, 1)).astype(int)
    rows, cpu_s, count = [], 0.0, 0
    for start in starts:
        begin = time.process_time()
        pairs = list(
            frame_pairs(
                template, ids, range(start, start + RUN),
                vertices=lambda at: np.array(sequence.vertices[at]),
                scan=lambda at: load_garment_scan(work / "garment" / "frames" / f"{ids[at]:06d}.npz", ids[at]).mesh,
                fps=capture.fps, config=config.projection,
            )
        )  # fmt: skip
        cpu_s += time.process_time() - begin
        count += len(pairs)
        for pair in pairs:
            fine = read_truth_frame(capture, pair.frame_id).vertices
            normals = vertex_normals(fine.astype(float), model.fine.faces)
            true = np.einsum("nk,nkc->nc", weights, normals[corners])
            true /= np.linalg.norm(true, axis=1, keepdims=True)
            points = np.einsum("nk,nkc->nc", weights, fine[corners])
            seen = _seen(capture, pair.frame_id, fine, model.fine.faces, points, true)
            placed = template.raster.at_vertices(np.array(sequence.vertices[ids.index(pair.frame_id)], float))
            there = _normals_at(Mesh(fine, model.fine.faces), normals, placed, pair.low)
            off = points - placed
            slid = np.linalg.norm(off - (off * true).sum(axis=1, keepdims=True) * true, axis=1)
            rows.append((_row(template, pair, there, seen, slid), _row(template, pair, true, seen, slid)))
    return rows, cpu_s / count, millimetres_per_texel(template.mesh, config.map.size)


def _normals_at(surface: Mesh, normals: np.ndarray, points: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Normals of a surface where lines through some points first meet it, at most REACH_M away; or nearest to them."""
    scene = TriangleScene((surface.vertices, surface.faces))
    found = scene.nearest(points)
    face, uv = found.faces, found.uv
    nearest = np.full(len(points), REACH_M)
    for direction in (along, -along):
        hits = scene.cast(np.concatenate([points, direction], axis=1))
        facing = np.zeros(len(points), bool)
        met = np.flatnonzero(hits.distance < nearest)
        facing[met] = (normals[surface.faces[hits.faces[met]]].sum(axis=1) * along[met]).sum(axis=1) > 0
        face[facing], uv[facing], nearest[facing] = hits.faces[facing], hits.uv[facing], hits.distance[facing]
    return normalised(np.einsum("nk,nkc->nc", barycentric(uv), normals[surface.faces[face]]))


def _row(template: MapTemplate, pair: FramePair, truth: np.ndarray, seen: np.ndarray, slid_m: np.ndarray) -> _Row:
    valid = pair.high.valid & template.raster.inside
    asked = np.zeros(len(valid), bool)
    asked[::RAY_STEP] = True
    asked &= template.raster.inside & seen
    low, high, true = pair.low[valid], pair.high.normals[valid], truth[valid]
    return _Row(
        signal_deg=float(_angle(low, true).mean()),
        high_deg=float(_angle(high, true).mean()),
        valid_percent=100 * float(valid[asked].mean()),
        residual=float(((high - true) ** 2).sum()),
        signal=float(((low - true) ** 2).sum()),
        slid_mm=1e3 * float(slid_m[valid].mean()),
    )


def _angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=1) / 2, 0, 1)))


def _seen(
    capture: Capture, frame_id: int, cloth: np.ndarray, faces: np.ndarray, points: np.ndarray, normals: np.ndarray
) -> np.ndarray:
    """Whether any camera has a free view of the outer side; only every RAY_STEP-th point is asked."""
    rig, body = load_rig(capture.path / "rig.json"), capture.body
    poses = load_poses(capture.path / "truth" / "poses.npz")
    assert body is not None
    posed = pose_frame(with_shape(body, poses.shape), poses, poses.row(frame_id)).vertices()
    scene = TriangleScene((cloth, faces), (posed, body.template.faces))
    asked = np.arange(0, len(points), RAY_STEP)
    seen = np.zeros(len(points), bool)
    for centre in rig.centres:
        origins = points[asked] + 5e-4 * normals[asked]
        towards = centre - origins
        facing = (towards * normals[asked]).sum(axis=1) > 0
        free = ~scene.is_met(np.concatenate([origins[facing], towards[facing]], axis=1), far=1.0)
        seen[asked[facing]] |= free
    return seen
