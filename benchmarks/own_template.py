"""Templates of a user's own: what UVs of several kinds are worth to the registration.

A take's template is taken for a stranger's mesh: as it is draped in the take's first pose, without its names, its
binding and its UVs. `capture4d template` makes a template of it again, from the mesh

    pattern     with its sewing pattern as UVs, in metres
    normalised  with the pattern scaled into the unit square, as exporters do
    none        without UVs
    fresh       without UVs, and gets some from the command
    boxes       without UVs, and gets those of a box projection, as a stranger may have unwrapped it
    triangles   without UVs, and gets every triangle laid out by itself

(the last two behind the command's back, which would cut an atlas anew where faces overlap), and the take is registered
with each. What counts is how far material points land from where they truly are
(`capture4d.captures.evaluation.correspondence_errors`), in the mean over vertices and frames, and its ratio to that
without UVs, the largest of the takes': lengths of a pattern help, and charts that were cut out of the mesh must do no
harm. Before UVs were compared with a pattern, `fresh` was at 1.9 times the error of `none` on the demo's take.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console

from benchmarks.cached_takes import cached_take
from benchmarks.learning_takes import true_places
from benchmarks.metric import Metric
from benchmarks.registered_work import QUICK_TAKE
from capture4d.body.sewing_pattern import with_known_pattern
from capture4d.body.skinning import pose_frame, with_shape
from capture4d.captures.capture import Capture, read_capture
from capture4d.captures.evaluation import correspondence_errors
from capture4d.captures.garment_scans import load_garment_scan
from capture4d.extraction.stage import ExtractionSettings
from capture4d.extraction.stage import run as extract
from capture4d.geometry.mesh import doubled_area_vectors
from capture4d.templates.garment import make_template
from capture4d.types import Body, Garment, Mesh, PoseSequence
from data_synth.config import PRESETS, GarmentStyle, MotionConfig, SynthConfig
from registration.config import RegistrationConfig
from registration.predictions import Mover
from registration.sequence import register_run
from registration.template import analyse_template

KINDS: dict[str, Callable[[Mesh], np.ndarray] | None] = {
    "pattern": lambda mesh: _uv(mesh),
    "normalised": lambda mesh: (_uv(mesh) - _uv(mesh).min()) / np.ptp(_uv(mesh)),
    "none": None,
    "fresh": None,
    "boxes": lambda mesh: _box_projection(mesh),
    "triangles": lambda mesh: _one_by_one(mesh),
}
PATTERNS = ("pattern", "normalised")
TAKES: tuple[SynthConfig, ...] = (
    PRESETS["demo"],
    replace(
        PRESETS["demo"],
        name="own-linen",
        fabric="linen",
        seed=2,
        frames=16,
        body_shape=(0.5, 1.0),
        style=GarmentStyle(ease=0.3, sleeve_length=0.8),
        motion=MotionConfig("reach"),
    ),
)
"""Two fabrics, people, cuts and motions."""


def run(*, quick: bool = False, frames: int = 36, workers: int = 2) -> list[Metric]:
    """Register takes with templates that differ in their UVs alone.

    Args:
        quick: one small take, twelve frames; the same keys.
        frames: of each take.
        workers: processes that make the takes; registration itself runs in one.
    """
    errors: dict[str, list[float]] = {kind: [] for kind in KINDS}
    judged: dict[str, list[bool]] = {kind: [] for kind in KINDS}
    for config in (QUICK_TAKE,) if quick else TAKES:
        capture = read_capture(cached_take(config, workers=workers))
        capture = replace(capture, frame_ids=capture.frame_ids[:frames])
        with tempfile.TemporaryDirectory(prefix="capture4d-own-template-") as scratch:
            extract(capture, Path(scratch) / "garment", ExtractionSettings(), workers=workers)
            truth = true_places(capture)
            for kind in KINDS:
                garment = _own_template(capture, kind)
                errors[kind].append(_error_mm(capture, Path(scratch) / "garment", garment, truth))
                judged[kind].append(bool(garment.pattern_metres))
                Console(stderr=True).print(f"{config.name}, {kind}: {errors[kind][-1]:.2f} mm")
    means = {kind: float(np.mean(values)) for kind, values in errors.items()}
    metrics = [Metric(f"own_template_{kind}_correspondence_mm", value, "mm") for kind, value in means.items()]
    metrics += [
        Metric(
            f"own_template_{kind}_to_none_ratio",
            max(a / b for a, b in zip(errors[kind], errors["none"], strict=True)),
        )
        for kind in KINDS
        if kind != "none"
    ]
    wrong = [kind for kind, found in judged.items() if any(each != (kind in PATTERNS) for each in found)]
    return [*metrics, Metric("own_template_misjudged", float(len(wrong)))]


def _uv(mesh: Mesh) -> np.ndarray:
    assert mesh.uv is not None
    return mesh.uv


def _own_template(capture: Capture, kind: str) -> Garment:
    """The take's template as the command makes it of a mesh that is draped on the body, with UVs of one kind."""
    body, poses = _moving(capture)
    bound = analyse_template(capture.template, RegistrationConfig())
    mover = Mover.create(bound, body, poses)
    assert mover is not None
    template = capture.template.template
    draped = Mesh(mover.skinned(0).astype(np.float32), template.faces, template.uv)
    unwrapped = KINDS[kind]
    uv = None if unwrapped is None else unwrapped(draped).astype(np.float32)
    mesh = Mesh(draped.vertices, draped.faces, uv if kind in PATTERNS else None)
    posed, names = pose_frame(with_shape(body, poses.shape), poses, 0), tuple(capture.template.loops)
    garment, _ = make_template(mesh, posed, uv="auto" if kind in (*PATTERNS, "fresh") else "none", names=names)
    if uv is not None and mesh.uv is None:
        garment = replace(garment, template=replace(garment.template, uv=uv), pattern_metres=None)
    return with_known_pattern(garment)


def _moving(capture: Capture) -> tuple[Body, PoseSequence]:
    moving = capture.posed_body
    assert moving is not None, "these takes bring their poses"
    return moving


def _error_mm(capture: Capture, garments: Path, garment: Garment, truth: np.ndarray) -> float:
    """Mean distance of material points from where they truly are."""
    config = RegistrationConfig()
    body, poses = _moving(capture)
    analysis = analyse_template(garment, config)
    mover = Mover.create(analysis, body, poses)
    row = {frame_id: index for index, frame_id in enumerate(capture.frame_ids)}
    errors = [
        correspondence_errors(result.vertices, truth[row[result.frame_id]]).mean()
        for result in register_run(
            analysis,
            mover,
            range(len(capture.frame_ids)),
            capture.frame_ids,
            load=lambda frame_id: load_garment_scan(garments / "frames" / f"{frame_id:06d}.npz", frame_id),
            done=lambda _, __: None,
            config=config,
        )
    ]
    return float(1e3 * np.mean(errors))


def _box_projection(mesh: Mesh) -> np.ndarray:
    """Every face as seen along the axis that it faces most, the six views side by side."""
    corners = mesh.vertices.astype(float)[mesh.faces]
    normals = doubled_area_vectors(mesh.vertices.astype(float), mesh.faces)
    axis = np.abs(normals).argmax(axis=1)
    positive = np.take_along_axis(normals, axis[:, None], axis=1)[:, 0] > 0
    others = np.array([[1, 2], [2, 0], [0, 1]])[axis]
    uv = np.take_along_axis(corners, others[:, None], axis=2)
    uv[..., 0] *= np.where(positive, 1.0, -1.0)[:, None]
    uv[..., 0] += 3.0 * (axis + 3 * positive)[:, None]
    return uv


def _one_by_one(mesh: Mesh) -> np.ndarray:
    """Every triangle by itself, in rows, as baking tools lay them out."""
    corners = mesh.vertices.astype(float)[mesh.faces]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    length = np.linalg.norm(first, axis=1)
    uv = np.zeros((len(corners), 3, 2))
    uv[:, 1, 0] = length
    uv[:, 2, 0] = np.einsum("fa,fa->f", first, second) / length
    uv[:, 2, 1] = np.linalg.norm(np.cross(first, second), axis=1) / length
    columns, room = int(np.ceil(np.sqrt(len(uv)))), 1.1 * float(np.ptp(uv, axis=1).max())
    row, column = np.divmod(np.arange(len(uv)), columns)
    return uv + room * np.stack([column, row], axis=1)[:, None]
