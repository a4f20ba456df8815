"""The garment model among the surfaces that `compare` sets side by side: its blendshapes, and its regression."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from capture4d.body import with_shape
from capture4d.errors import InputError
from capture4d.types import Body, PoseSequence, RegisteredSequence
from retarget.blendshapes import project, reconstruct, shape_space, skin_frames
from retarget.bodies import captured_person, retargeted_mean
from retarget.controls import control_vectors
from retarget.pose_normalisation import PoseRows, unpose_sequence
from retarget.stage import GarmentModel

__all__ = ["ModelledSurface", "modelled_surfaces"]

UNSEEN_WEIGHT = 0.05
"""Of vertices without scan data when a frame is projected on the blendshapes, as in `capture4d fit`."""
MB = 1e6


@dataclass(frozen=True, slots=True, eq=False)
class ModelledSurface:
    """What the model makes of some frames."""

    name: str
    vertices: np.ndarray
    """(T, V, 3) float32, metres, world."""
    ms_per_frame: float
    megabytes: float


def modelled_surfaces(
    known: GarmentModel, sequence: RegisteredSequence, body: Body, poses: PoseSequence, rows: range
) -> list[ModelledSurface]:
    """Blendshapes: the registered frames, projected on the model's directions. Regression: the garment from the poses
    alone, by the LSTM if the model has one.

    Args:
        sequence, body, poses: a registered take, and what moved it.
        rows: frames of the sequence that are wanted; the regression sees the motion from the take's beginning.
    Raises:
        InputError: the model is of another template or skeleton.
    """
    model, garment = known.model, sequence.garment
    if not np.array_equal(model.garment.template.faces, garment.template.faces):
        raise InputError(
            f"{known.folder}: expected a model of the template that was registered "
            f"({len(garment.template.vertices)} vertices), found one of {len(model.garment.template.vertices)}"
        )
    weights = model.garment.skin_weights
    assert weights is not None
    person = captured_person(model, known.body)
    matched = PoseRows.match(sequence, with_shape(body, poses.shape), poses)
    unposed = list(unpose_sequence(sequence, matched, person.shape, unseen_weight=UNSEEN_WEIGHT))
    frames, seen = (np.stack([unposed[row][part] for row in rows]) for part in (0, 1))
    regressor = known.linear if known.lstm is None else known.lstm
    controls = control_vectors(regressor.layout, matched.poses)
    mean = retargeted_mean(model, person, matched.shaped).astype(np.float32)  # on the person as this take was tracked
    begin = time.perf_counter()
    predicted = regressor.predict(controls)
    ms = 1e3 * (time.perf_counter() - begin) / len(controls)
    answers = (
        ("blendshapes", project(shape_space(model), frames, seen), 0.0, 0),
        ("regression", predicted[rows.start : rows.stop], ms, _regressor_size(known)),
    )
    surfaces = []
    for name, coefficients, extra_ms, size in answers:
        vertices, times = [], []
        for row, wanted in zip(rows, coefficients, strict=True):
            begin = time.perf_counter()
            rest = reconstruct(mean, model.basis, wanted[None])
            placed = skin_frames(rest, weights, matched.transforms(row)[None])
            times.append(1e3 * (time.perf_counter() - begin))
            vertices.append(placed[0])
        megabytes = (model.basis.nbytes + model.mean.nbytes + size) / MB
        surfaces.append(ModelledSurface(name, np.stack(vertices), float(np.median(times)) + extra_ms, megabytes))
    return surfaces


def _regressor_size(known: GarmentModel) -> int:
    """Of the regressor's file, bytes."""
    name = "linear.safetensors" if known.lstm is None else "lstm.safetensors"
    return (known.folder / name).stat().st_size
