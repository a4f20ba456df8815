"""A garment learned as offsets from a body that is not the right one: too thin, too thick, or wrongly skinned.

The drapes stay; only the body that offsets start from is another (Jin et al., section 6.3 and appendix D). Limits this
was built against: over seven bodies the largest test error at most 1.05 of the smallest; skin weights of an upper arm
that are painted on the chest, so that it moves by 5 cm, at most 1.10 of the true ones. Paint on chest and other arm, so
that they move by 14 cm, is reported as it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from rich.console import Console

from benchmarks.metric import Metric
from capture4d.body.skinning import pose_frame, with_shape
from capture4d.types import Body, PoseSequence
from wrinkles.offset_images.canvas import OffsetSampler
from wrinkles.offset_images.config import OffsetTrainingConfig
from wrinkles.offset_images.drape_lessons import DrapeLesson, drape_lesson, read_parted_drapes, still_poses
from wrinkles.offset_images.frames import vertex_errors_cm
from wrinkles.offset_images.kernels import fit_kernels
from wrinkles.offset_images.networks import PcaFullyConnected
from wrinkles.offset_images.training import OffsetLesson, predict, train_offsets

__all__ = ["thicker", "wrong_body_metrics", "wrongly_skinned"]

GIRTH, SHARES = 1, (-1.0, -0.5, 0.0, 0.5, 1.0, 1.5, 2.0)
"""The direction of the shape space that is sculpted wrongly, and by how many standard deviations."""
ARM, OTHER_ARM = "upperarm01.L", "upperarm01.R"
CHEST = (0.5, 0.05, 0.08)
"""Where the paint lies: this share of the way from the spine to the arm, and its widths across and along, metres."""
COMPONENTS = 128


def wrong_body_metrics(drapes: Path, *, epochs: int, texels: int) -> list[Metric]:
    """Kernels and fully connected with PCA, learned over wrong bodies from drapes without mirror images."""
    found, parts = read_parted_drapes(drapes)
    poses = still_poses(found, parts.train[:100])
    bodies = {f"shape {share:g}": thicker(found.body, share) for share in SHARES}
    bodies["skinning 5 cm"] = wrongly_skinned(found.body, poses, 0.05)
    bodies["skinning 14 cm"] = wrongly_skinned(found.body, poses, 0.14, both=True)
    errors: dict[str, dict[str, float]] = {}
    for name, body in bodies.items():
        lesson = drape_lesson(replace(found, body=body), parts, texels=texels, space="local", mirrored=False)
        errors[name] = _errors(lesson, epochs)
        told = ", ".join(f"{method} {error:.3f} cm" for method, error in errors[name].items())
        Console(stderr=True).print(f"wrong body, {name}: {told}", soft_wrap=True)
    return _metrics(errors)


def _errors(lesson: DrapeLesson, epochs: int) -> dict[str, float]:
    """Of vertices on drapes for tests, cm, by method."""
    sampler, test = OffsetSampler(lesson.layout), lesson.test
    offsets = fit_kernels(lesson.train)[0].offsets(test.pose)
    kernels = vertex_errors_cm(sampler.positions(offsets, test.points, test.axes), test.vertices)
    torch.manual_seed(0)
    network = PcaFullyConnected.analysed(lesson.train.pose.shape[1], lesson.train.offsets, components=COMPONENTS)
    task = OffsetLesson(lesson.layout, lesson.train, lesson.validation)
    train_offsets(network, task, OffsetTrainingConfig(epochs=epochs, patience=epochs))
    return {"kernels": kernels, "pca": vertex_errors_cm(predict(network, sampler, test), test.vertices)}


def _metrics(errors: Mapping[str, Mapping[str, float]]) -> list[Metric]:
    found = []
    for method in ("kernels", "pca"):
        shapes = [each[method] for name, each in errors.items() if name.startswith("shape")]
        true = errors["shape 0"][method]
        found += [
            Metric(f"wrong_shapes_{method}", max(shapes) / min(shapes)),
            Metric(f"wrong_skinning_{method}", errors["skinning 5 cm"][method] / true),
            Metric(f"wrong_skinning_strong_{method}", errors["skinning 14 cm"][method] / true),
        ]
    return found


def thicker(body: Body, share: float) -> Body:
    """A body whose skin is thicker or thinner, on the same skeleton."""
    moved = body.template.vertices + share * body.shape_directions[GIRTH]
    return replace(body, template=body.template.with_vertices(moved.astype(np.float32)))


def wrongly_skinned(body: Body, poses: PoseSequence, most_m: float, *, both: bool = False) -> Body:
    """A body whose chest follows the left upper arm in part, and with `both` the other upper arm as well.

    Args:
        poses: the poses among which the skin moves at most by `most_m`, metres.
    """
    arm = body.joint_names.index(ARM)
    paint = _paint(body, _chest(body))
    if both:
        paint = np.maximum(paint, _paint(body, body.joints[body.joint_names.index(OTHER_ARM)].astype(np.float64)))
    whole = _painted(body, arm, paint)
    most = 0.0
    for row in range(len(poses.frame_ids)):
        true, wrong = (pose_frame(with_shape(each, poses.shape), poses, row).vertices() for each in (body, whole))
        most = max(most, float(np.linalg.norm(wrong - true, axis=1).max()))
    return _painted(body, arm, min(most_m / most, 1.0) * paint)


def _painted(body: Body, joint: int, paint: Float64[np.ndarray, " verts"]) -> Body:
    weights = (1 - paint[:, None]) * body.skin_weights
    weights[:, joint] += paint
    return replace(body, skin_weights=(weights / weights.sum(axis=1, keepdims=True)).astype(np.float32))


def _chest(body: Body) -> Float64[np.ndarray, "3"]:
    """The skin in front of the place between spine and arm."""
    spine, arm = (body.joints[body.joint_names.index(name)] for name in ("spine01", ARM))
    middle = spine + CHEST[0] * (arm - spine)
    near = np.linalg.norm((body.template.vertices - middle)[:, :2], axis=1) < 0.03
    return body.template.vertices[near][np.argmax(body.template.vertices[near][:, 2])].astype(np.float64)


def _paint(body: Body, centre: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, " verts"]:
    away = (body.template.vertices - centre) / np.array([CHEST[1], CHEST[2], CHEST[1]])
    return np.exp(-np.square(away).sum(axis=1))
