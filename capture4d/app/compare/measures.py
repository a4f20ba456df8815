"""How far the compared surfaces are from the scans' maps, and from the truth where there is one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from capture4d.app.compare.methods import NETWORK, Method
from capture4d.captures.capture import Capture
from capture4d.captures.evaluation import correspondence_errors, material_points
from capture4d.captures.truth import TruthModel, read_truth_vertices
from capture4d.geometry.uv_layout import millimetres_per_texel
from wrinkles.normal_maps.metrics import score
from wrinkles.normal_maps.pairs import PairTake
from wrinkles.normal_maps.template import MapTemplate

__all__ = ["Row", "conclusion", "measure", "true_vertices"]

SEEN = ("registration", "blendshapes", NETWORK)
"""Surfaces that know the scans of the frames they show; the others know their poses alone."""
ALIKE = 0.05
"""Errors that differ by a smaller share are called alike: so much lies between two trainings of one network."""


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


def conclusion(rows: Sequence[Row], *, against_truth: bool) -> str:
    """What a reader should take from the table: whether the network's maps are worth having, and which surface to
    take where there are poses and no scans."""
    goal = "the true positions" if against_truth else "the registration"
    return " ".join(filter(None, (_of_maps(rows), _of_poses(rows, goal))))


def _of_maps(rows: Sequence[Row]) -> str:
    named = {row.name: row for row in rows}
    bare, made = named.get("registration"), named.get(NETWORK)
    if bare is None or made is None or bare.normal_deg is None or made.normal_deg is None:
        return ""
    kept = [row.wrinkle_energy_kept for row in (made, bare)]
    wrinkles = "" if None in kept else f", and {kept[0]:.2f} of their wrinkle energy where it has {kept[1]:.2f}"
    numbers = f"{made.normal_deg:.1f} deg off the scans' normals where the bare registration is {bare.normal_deg:.1f}"
    if made.normal_deg < (1 - ALIKE) * bare.normal_deg:
        return f"The network's maps are worth having: they are {numbers}{wrinkles}."
    return f"The network's maps are not worth having: they are {numbers}{wrinkles}."


def _of_poses(rows: Sequence[Row], goal: str) -> str:
    by_pose = [row for row in rows if row.name not in SEEN and row.vertex_mm is not None]
    fair = sorted((row for row in by_pose if not row.learned), key=lambda row: row.vertex_mm or 0.0)
    if not by_pose:
        return ""
    if not fair:
        return "What was made from the poses alone has learned from these frames: nothing follows about other motions."
    best, error = fair[0], fair[0].vertex_mm or 0.0
    alike = [row.name for row in fair[1:] if (row.vertex_mm or 0.0) * (1 - ALIKE) < error]
    farther = [f"{row.name} {row.vertex_mm:.1f}" for row in fair[1:] if row.name not in alike]
    said = f"From poses alone, take {best.name}: {error:.1f} mm from {goal}"
    said += f"; {' and '.join(alike)} {'is' if len(alike) == 1 else 'are'} as good" if alike else ""
    said += f"; farther are {', '.join(farther)}" if farther else ""
    return f"{said}; rows with an asterisk are left out of this." if len(fair) < len(by_pose) else f"{said}."


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
