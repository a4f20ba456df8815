"""How far predicted garments are from their drapes, by part, and how much of the fine folds is there.

References: TailorNet (CVPR 2020), section 6: mean vertex error, by the four parts. That millimetres and sharpness pull
apart (a blend of many is smooth and near in the mean) is why the fine part is measured as well.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from capture4d.geometry.mesh import vertex_normals
from retarget.mixture.config import SplitConfig
from retarget.mixture.diffusion import Diffusion
from retarget.mixture.lesson import PARTS, PairDrapes, Part, StyleLesson
from retarget.mixture.styled_garment import StyledGarment

__all__ = ["PartErrors", "Unposed", "measure", "unposed_by"]

MM = 1e3
Unposed = Callable[[PairDrapes], np.ndarray]
"""Predicts the drapes of a pair, unposed, (N, V, 3), metres."""


@dataclass(frozen=True, slots=True)
class PartErrors:
    """Means over the drapes of a part."""

    drapes: int
    vertex_mm: float
    """Distance of a vertex, in the pose."""
    unposed_mm: float
    """The same without the pose, as the paper's code measures it."""
    normal_deg: float
    """Angle between the normals of a vertex, in the pose."""
    fine_share: float
    """Root of the energy of the fine part about its own mean over a pair's poses, predicted over true; 1 is as lively
    as the truth. NaN where every pair has one drape."""


def unposed_by(garment: StyledGarment) -> Unposed:
    """What a learned garment says to the drapes of a pair."""

    def predict(pair: PairDrapes) -> np.ndarray:
        style = {}
        for name, (low, high) in garment.ranges.style.items():
            place = pair.numbers[list(garment.ranges.style).index(name)]
            style[name] = (low + high) / 2 + place * (high - low) / 2
        return garment.worn([float(value) for value in pair.person.shape], style).unposed(pair.rotations)

    return predict


def measure(lesson: StyleLesson, predict: Unposed) -> Mapping[Part, PartErrors]:
    """Errors of a prediction in every part that has drapes."""
    diffusion = Diffusion.create(lesson.garment.template.faces, lesson.pairs[0].canonical, SplitConfig())
    predicted = {pair.name: predict(pair) for pair in lesson.pairs}
    found: dict[Part, PartErrors] = {}
    for part in PARTS:
        rows = [
            _drape_errors(lesson, diffusion, pair, predicted[pair.name], chosen)
            for pair, chosen in lesson.of_part(part)
        ]
        if rows:
            found[part] = _joined(rows)
    return found


def _drape_errors(
    lesson: StyleLesson, diffusion: Diffusion, pair: PairDrapes, said: np.ndarray, rows: np.ndarray
) -> dict[str, Float64[np.ndarray, " drapes"]]:
    """Errors of each chosen drape of a pair; and its fine energies, which are about the mean of those drapes."""
    faces, weights = lesson.garment.template.faces, lesson.skin_weights
    said, truth = said.astype(np.float64), pair.unposed.astype(np.float64)
    posed_said, posed_truth = (pair.posed(each, weights)[rows] for each in (said, truth))
    angles = []
    for one, other in zip(posed_said, posed_truth, strict=True):
        cosine = np.einsum("vx,vx->v", vertex_normals(one, faces), vertex_normals(other, faces))
        angles.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean())
    return {
        "vertex": np.linalg.norm(posed_said - posed_truth, axis=2).mean(axis=1),
        "unposed": np.linalg.norm(said[rows] - truth[rows], axis=2).mean(axis=1),
        "normal": np.array(angles),
        "fine_said": _fine_energy(said[rows], diffusion),
        "fine_true": _fine_energy(truth[rows], diffusion),
    }


def _fine_energy(
    unposed: Float64[np.ndarray, "drapes verts 3"], diffusion: Diffusion
) -> Float64[np.ndarray, " drapes"]:
    """Mean square of what smoothing takes away, about its mean over the drapes."""
    fine = unposed - diffusion.smooth(unposed)
    return ((fine - fine.mean(axis=0)) ** 2).sum(axis=2).mean(axis=1)


def _joined(rows: list[dict[str, np.ndarray]]) -> PartErrors:
    every = {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}
    true = float(every["fine_true"].sum())
    share = np.sqrt(float(every["fine_said"].sum()) / true) if true > 0 else float("nan")
    return PartErrors(
        drapes=len(every["vertex"]),
        vertex_mm=MM * float(every["vertex"].mean()),
        unposed_mm=MM * float(every["unposed"].mean()),
        normal_deg=float(every["normal"].mean()),
        fine_share=float(share),
    )
