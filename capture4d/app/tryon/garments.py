"""What can be tried on: a garment that `fit` or `fit-styles` learned, on one person, asked pose by pose.

garment = open_garment(Path("WORK"))
worn = garment.worn(beta=(0.5,), style={})
unposed = worn.unposed(rotations, translation)      # as pose after pose of a motion
worn.moving(...), worn.resting(...)                 # in the pose, out of the body
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Float32, Float64

from capture4d.app.tryon.push import LivePush, laid_on_skin
from capture4d.body.limbs import WornBody
from capture4d.body.skinning import PosedBody, ShapedBody, sparse_weights, with_pose
from capture4d.body.surface_kernels import skin_sparse
from capture4d.errors import InputError
from capture4d.geometry.intersection_removal import NOISE_M, Penetration
from capture4d.types import Body, Garment, PoseSequence
from retarget.animation.animator import Animator
from retarget.animation.bodies import captured_person, retargeted_mean
from retarget.animation.garment_model import GarmentModel, load_garment_model
from retarget.config import AnimateConfig
from retarget.mixture.config import MODEL as STYLES_MODEL
from retarget.regression.controls import ControlStream, control_vectors
from retarget.regression.known_range import PoseRange

__all__ = ["Fitting", "TriedGarment", "WornLive", "open_garment"]

SHAPES = 3
"""Components of the body's shape that have a slider: height, girth and what comes third."""
SHAPE_RANGE = (-2.0, 2.0)
"""Standard deviations, of a model that was learned on one person."""
MARGIN_M = 0.003
"""How far over the skin cloth is pushed while it moves: between a frame's two searches its feet wander a little."""


@runtime_checkable
class WornLive(Protocol):
    """A garment on one person. Poses are asked in the order of a motion, frame by frame at the garment's rate."""

    @property
    def person(self) -> ShapedBody: ...

    @property
    def at_rest(self) -> Float64[np.ndarray, "verts 3"]:
        """The garment in the person's rest pose, metres."""
        ...

    def begin(self) -> None:
        """Forget the poses that went before."""
        ...

    def unposed(self, body: PosedBody, translation: np.ndarray) -> Float64[np.ndarray, "verts 3"]:
        """The garment of the next pose, as it is in the rest pose, metres."""
        ...

    def resting(self, poses: PoseSequence) -> Float32[np.ndarray, "verts 3"]:
        """The garment as `animate` has it in the last of some poses, metres.

        Args:
            poses: a motion at the garment's rate that ends in the pose, long enough for all that the garment remembers.
        """
        ...

    @property
    def remembers(self) -> int:
        """Poses before the present one that count."""
        ...


@runtime_checkable
class TriedGarment(Protocol):
    """A model, ready to be put on somebody."""

    @property
    def path(self) -> Path: ...

    @property
    def body(self) -> Body: ...

    @property
    def garment(self) -> Garment: ...

    @property
    def fps(self) -> float:
        """The rate at which it wants to be asked."""
        ...

    @property
    def clip_fps(self) -> float | None:
        """The rate that clips have to have; None where any will do."""
        ...

    @property
    def learned(self) -> PoseRange: ...

    @property
    def style_ranges(self) -> Mapping[str, tuple[float, float]]:
        """Least and most of each number of the pattern; empty of a garment without styles."""
        ...

    @property
    def shape_ranges(self) -> Sequence[tuple[float, float]]:
        """Least and most of each shape component that has a slider."""
        ...

    @property
    def first_shape(self) -> Sequence[float]:
        """Who wears it at first."""
        ...

    def worn(self, beta: Sequence[float], style: Mapping[str, float]) -> WornLive:
        """The garment on a person.

        Raises:
            InputError: shape or style are outside what was learned.
        """
        ...


def open_garment(path: Path) -> TriedGarment:
    """What `fit` or `fit-styles` wrote.

    Raises:
        InputError: there is no model, or it is damaged or unfinished.
    """
    if (path / STYLES_MODEL).is_file():
        return StyledTried(path)
    return LearnedTried(load_garment_model(path), path)


# --- without styles ----------------------------------------------------------------------------------------------


class LearnedTried:
    """A garment that was learned from takes of one person."""

    def __init__(self, model: GarmentModel, path: Path) -> None:
        self.model, self.path = model, path

    @property
    def body(self) -> Body:
        return self.model.body

    @property
    def garment(self) -> Garment:
        return self.model.model.garment

    @property
    def fps(self) -> float:
        return self.model.model.fps

    @property
    def clip_fps(self) -> float | None:
        return self.fps

    @property
    def learned(self) -> PoseRange:
        return self.model.limits.poses

    @property
    def style_ranges(self) -> Mapping[str, tuple[float, float]]:
        return {}

    @property
    def shape_ranges(self) -> Sequence[tuple[float, float]]:
        count = min(SHAPES, len(self.body.shape_directions))
        return [(min(SHAPE_RANGE[0], value), max(SHAPE_RANGE[1], value)) for value in self.first_shape[:count]]

    @property
    def first_shape(self) -> Sequence[float]:
        return [float(value) for value in self.model.person().shape]

    def worn(self, beta: Sequence[float], style: Mapping[str, float]) -> WornLive:
        if style:
            raise InputError("style: expected a garment with styles, which fit-styles learns, found another")
        return _LearnedWorn(self.model, self.model.person(beta))


class _LearnedWorn:
    def __init__(self, known: GarmentModel, person: ShapedBody) -> None:
        self.person, self._known = person, known
        self._mean = retargeted_mean(known.model, captured_person(known.model, known.body), person)
        self._animator = Animator(known.model, person, self._mean, AnimateConfig())
        self._regressor = known.best
        self._flat = np.ascontiguousarray(known.model.basis.reshape(len(known.model.std), -1))
        self.begin()

    @property
    def at_rest(self) -> Float64[np.ndarray, "verts 3"]:
        return self._mean

    @property
    def remembers(self) -> int:
        config = self._regressor.layout.config
        return max((config.derivative_frames, *config.lags)) + 1

    def begin(self) -> None:
        self._controls, self._stream = ControlStream(self._regressor.layout), self._regressor.stream()
        self._asked = 0

    def unposed(self, body: PosedBody, translation: np.ndarray) -> Float64[np.ndarray, "verts 3"]:
        time_s = self._asked / self._regressor.layout.fps
        controls = self._controls.push(np.asarray(body.rotations), np.asarray(translation), time_s)
        self._asked += 1
        coefficients = self._stream.push(controls.astype(np.float32))
        return self._mean + (coefficients @ self._flat).reshape(self._mean.shape)

    def resting(self, poses: PoseSequence) -> Float32[np.ndarray, "verts 3"]:
        regressor = self._regressor
        coefficients = regressor.predict(control_vectors(regressor.layout, poses))
        return self._animator.frames(poses, coefficients, [len(poses.frame_ids) - 1])[0].vertices


# --- with styles -------------------------------------------------------------------------------------------------


class StyledTried:
    """A garment in all its styles, on everybody."""

    def __init__(self, path: Path) -> None:
        # torch takes a second to load
        from retarget.mixture.model_files import load_styled_garment

        self.path, self.known = path, load_styled_garment(path)

    @property
    def body(self) -> Body:
        return self.known.body

    @property
    def garment(self) -> Garment:
        return self.known.garment

    @property
    def fps(self) -> float:
        return 30.0

    @property
    def clip_fps(self) -> float | None:
        return None  # a pose alone decides

    @property
    def learned(self) -> PoseRange:
        return self.known.learned

    @property
    def style_ranges(self) -> Mapping[str, tuple[float, float]]:
        return dict(self.known.ranges.style)

    @property
    def shape_ranges(self) -> Sequence[tuple[float, float]]:
        return [*self.known.ranges.shape][:SHAPES]

    @property
    def first_shape(self) -> Sequence[float]:
        return [(low + high) / 2 for low, high in self.known.ranges.shape]

    def worn(self, beta: Sequence[float], style: Mapping[str, float]) -> WornLive:
        return _StyledWorn(self.known.worn(beta, style))


class _StyledWorn:
    remembers = 0

    def __init__(self, worn) -> None:  # a WornGarment, whose module loads torch
        self.person, self._worn, self.at_rest = worn.person, worn, worn.in_a_pose

    def begin(self) -> None:
        pass

    def unposed(self, body: PosedBody, translation: np.ndarray) -> Float64[np.ndarray, "verts 3"]:
        return self._worn.unposed(np.asarray(body.rotations)[None])[0]

    def resting(self, poses: PoseSequence) -> Float32[np.ndarray, "verts 3"]:
        return self._worn.outside(poses.rotations[-1], poses.translations[-1]).vertices.astype(np.float32)


# --- on the person -----------------------------------------------------------------------------------------------


class Fitting:
    """A garment on a person, out of the body: quickly while the pose changes, exactly when it rests."""

    def __init__(self, tried: TriedGarment, beta: Sequence[float], style: Mapping[str, float]) -> None:
        weights = tried.garment.skin_weights
        assert weights is not None
        self.worn = tried.worn(beta, style)
        self.faces = tried.garment.template.faces
        self._cloth_skin, self._body_skin = sparse_weights(weights), _body_skin(tried.body)
        self._body = WornBody(self.worn.person, self.worn.at_rest, weights)
        self._push = LivePush(self._body, self.faces, len(self.worn.at_rest), MARGIN_M)

    def moving(
        self, rotations: Float[np.ndarray, "joints 3 3"], translation: Float[np.ndarray, "3"]
    ) -> tuple[Float64[np.ndarray, "verts 3"], Float64[np.ndarray, "skin 3"]]:
        """The garment and the body's surface in the next pose of a motion, metres."""
        body = with_pose(self.worn.person, rotations, translation)
        skinned = skin_sparse(body.corrected(), *self._body_skin, body.transforms)
        with _one_thread():
            unposed = np.ascontiguousarray(self.worn.unposed(body, translation), np.float64)
        return self._push(skin_sparse(unposed, *self._cloth_skin, body.transforms), skinned), skinned

    def resting(self, poses: PoseSequence) -> tuple[Float64[np.ndarray, "verts 3"], Float64[np.ndarray, "skin 3"]]:
        """The same as `animate` has it in the last of some poses; what it leaves inside is laid on the skin."""
        shaped = replace(poses, shape=np.asarray(self.worn.person.shape, np.float32))
        skinned = with_pose(self.worn.person, poses.rotations[-1], poses.translations[-1]).vertices()
        with _one_thread():
            vertices = self.worn.resting(shaped)
        return laid_on_skin(vertices.astype(np.float64), self._body.posed(skinned), NOISE_M), skinned

    def inside(self, vertices: Float[np.ndarray, "verts 3"], skinned: Float[np.ndarray, "skin 3"]) -> Penetration:
        """How much of it is inside the body, measured as `animate` does."""
        return Penetration.of(self._body.posed(skinned).contacts(np.asarray(vertices, np.float64)))


@contextmanager
def _one_thread() -> Iterator[None]:
    """Of torch, if it is loaded at all. For one window of an LSTM more threads bring nothing, and on a busy machine
    they wait for each other, awake: 48 ms where one takes 2."""
    torch = sys.modules.get("torch")
    if torch is None:
        yield
        return
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@functools.lru_cache(maxsize=1)
def _body_skin(body: Body) -> tuple[np.ndarray, np.ndarray]:
    """`sparse_weights`, once for all people: to sort them takes longer than a frame."""
    return sparse_weights(body.skin_weights)
