"""The garment model among the surfaces that `compare` sets side by side: blendshapes, regressions, other people."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from capture4d.body.skinning import pose_frame, with_shape
from capture4d.errors import InputError
from capture4d.types import Body, Mesh, PoseSequence, RegisteredSequence
from data_synth.config import OTHER_BODIES
from retarget.animation.animator import Animator
from retarget.animation.bodies import captured_person, retargeted_mean
from retarget.animation.garment_model import GarmentModel
from retarget.config import AnimateConfig, ShapeConfig
from retarget.model_folder import regressor_files
from retarget.regression.controls import control_vectors
from retarget.shapes.blendshapes import project, reconstruct, shape_space, skin_frames
from retarget.shapes.pose_normalisation import PoseRows, unpose_sequence

__all__ = ["PEOPLE", "Dressed", "Modelled", "ModelledSurface", "model_take"]

PEOPLE: Mapping[str, tuple[float, ...] | None] = {"as captured": None, **OTHER_BODIES}
"""Whom the garment is shown on: first coefficients of their shape."""
_IN_WORDS = {"linear": "linear", "lstm": "LSTM", "kernel": "kernels", "ensemble": "kernels and LSTM"}
MB = 1e6


@dataclass(frozen=True, slots=True, eq=False)
class ModelledSurface:
    """What the model makes of some frames."""

    name: str
    vertices: np.ndarray
    """(T, V, 3) float32, metres, world."""
    ms_per_frame: float
    megabytes: float


@dataclass(frozen=True, slots=True, eq=False)
class Dressed:
    """One moment on one person."""

    who: str
    garment: Mesh
    body: Mesh


@dataclass(frozen=True, slots=True, eq=False)
class Modelled:
    """A take as the model has it."""

    known: GarmentModel
    poses: PoseSequence
    """Of the take, in the order of its registered frames."""
    surfaces: Sequence[ModelledSurface]
    coefficients: np.ndarray
    """(T, K) float32 of all frames, from the poses, by the best regressor that the model has."""

    def on_people(self, row: int) -> list[Dressed]:
        """A frame of the take on other people, out of their bodies."""
        model, body = self.known.model, self.known.body
        captured = captured_person(model, body)
        dressed = []
        for who, first in PEOPLE.items():
            shape = captured.shape.copy()
            if first is not None:
                shape[:] = 0
                shape[: len(first)] = first[: len(shape)]
            person = with_shape(body, shape)
            mean = retargeted_mean(model, captured, person)
            animator = Animator(model, person, mean, AnimateConfig())
            (frame,) = animator.frames(self.poses, self.coefficients, [row])
            posed = pose_frame(person, self.poses, row).vertices().astype(np.float32)
            garment = model.garment.template.with_vertices(frame.vertices)
            dressed.append(Dressed(who, garment, body.template.with_vertices(posed)))
        return dressed


def model_take(
    known: GarmentModel, sequence: RegisteredSequence, body: Body, poses: PoseSequence, rows: Sequence[int]
) -> Modelled:
    """Blendshapes: the registered frames, projected on the model's directions. Regression: the garment from the poses
    alone.

    Args:
        sequence, body, poses: a registered take, and what moved it.
        rows: frames of the sequence that are wanted; regressions see the motion from the take's beginning.
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
    unposed = list(unpose_sequence(sequence, matched, person.shape, unseen_weight=ShapeConfig().unseen_weight))
    frames, seen = (np.stack([unposed[row][part] for row in rows]) for part in (0, 1))
    answers = {"blendshapes": (project(shape_space(model), frames, seen).astype(np.float32), 0.0, 0)}
    coefficients = np.zeros((0, 0), np.float32)
    for name, regressor in known.regressors.items():
        controls = control_vectors(regressor.layout, matched.poses)
        stream, said, times = regressor.stream(), [], []
        for each in controls:
            begin = time.perf_counter()
            said.append(stream.push(each))
            times.append(1e3 * (time.perf_counter() - begin))
        coefficients, ms = np.stack(said), float(np.median(times))
        size = sum(path.stat().st_size for path in regressor_files(known.folder, name))
        answers[f"regression, {_IN_WORDS[name]}"] = coefficients[list(rows)], ms, size
    mean = retargeted_mean(model, person, matched.shaped).astype(np.float32)  # on the person as this take was tracked
    surfaces = []
    for name, (wanted, extra_ms, size) in answers.items():
        vertices, times = [], []
        for row, each in zip(rows, wanted, strict=True):
            begin = time.perf_counter()
            rest = reconstruct(mean, model.basis, each[None])
            placed = skin_frames(rest, weights, matched.transforms(row)[None])
            times.append(1e3 * (time.perf_counter() - begin))
            vertices.append(placed[0])
        megabytes = (model.basis.nbytes + model.mean.nbytes + size) / MB
        surfaces.append(ModelledSurface(name, np.stack(vertices), float(np.median(times)) + extra_ms, megabytes))
    return Modelled(known, matched.poses, surfaces, coefficients)
