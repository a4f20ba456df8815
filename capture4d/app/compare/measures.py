"""How far the compared surfaces are from the scans' maps, and from the truth where there is one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from capture4d.app.compare.methods import Method
from capture4d.captures.capture import Capture
from capture4d.captures.evaluation import correspondence_errors, material_points
from capture4d.captures.truth import TruthModel, read_truth_vertices
from capture4d.geometry.uv_layout import millimetres_per_texel
from wrinkles.normal_maps.metrics import score
from wrinkles.normal_maps.pairs import PairTake
from wrinkles.normal_maps.template import MapTemplate

__all__ = ["Row", "measure", "true_vertices"]


@dataclass(frozen=True, slots=True)
class Row:
    """A surface in the table."""

    name: str
    vertex_mm: float | None
    normal_deg: float | None
    wrinkle_energy_kept: float | None
    flicker_deg: float | None
    ms_per_frame: float
    model_mb: float
    learned: bool
    """From some of these very frames: then it shows what the model holds, not what it foresees."""


def true_vertices(capture: Capture, model: TruthModel, frame_ids: np.ndarray) -> np.ndarray:
    """Where the template's vertices truly are (T, V, 3), metres, world."""
    return np.stack(
        [
            material_points(
                read_truth_vertices(capture, int(frame_id)), model.fine.faces, model.template_faces,
                model.template_barycentric,
            )
            for frame_id in frame_ids
        ]
    )  # fmt: skip


def measure(methods: Sequence[Method], template: MapTemplate, held: PairTake, truth: np.ndarray | None) -> list[Row]:
    """Normals against the scans' maps; vertices against the truth, or, where there is none, against the registration.

    Args:
        methods: the registration first.
        truth: the vertices' true positions (T, V, 3).
    """
    return [_measure(method, template, held, truth, methods[0]) for method in methods]


def _measure(
    method: Method, template: MapTemplate, held: PairTake, truth: np.ndarray | None, registered: Method
) -> Row:
    raster = template.raster
    images = [
        raster.image((normals @ template.rotation(vertices)).astype(np.float32))
        for normals, vertices in zip(method.normals, registered.vertices, strict=True)
    ]
    maps = torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2)
    consecutive = torch.zeros(len(maps), dtype=torch.bool)
    consecutive[torch.from_numpy(held.consecutive())] = True
    scores = score(
        maps, held.high.float(), held.valid & torch.from_numpy(raster.image(raster.inside)),
        mm_per_texel=millimetres_per_texel(template.mesh, raster.size), consecutive=consecutive,
    )  # fmt: skip
    reference = truth if truth is not None else None if method is registered else registered.vertices
    errors = [] if reference is None else [
        correspondence_errors(a, b).mean() for a, b in zip(method.vertices, reference, strict=True)
    ]  # fmt: skip
    return Row(
        method.name, _number(1e3 * float(np.mean(errors))) if errors else None, _number(scores.normal_error_deg),
        _number(scores.wrinkle_energy_kept), _number(scores.flicker_deg), method.ms_per_frame, method.megabytes,
        method.learned,
    )  # fmt: skip


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
