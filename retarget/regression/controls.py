"""What drives the garment: the control vector of each frame.

Rotations of the garment's joints relative to their parents, as the first two columns of R - I (6 numbers a joint), and
velocity (m/s) and acceleration (m/s^2) of the root in the root's frame. The past alone decides, so that a frame can be
answered as it comes: derivatives are those of a parabola through the present frame and a few before.

References: DeepWrinkles (ECCV 2018), section 3.3. Zhou et al., On the Continuity of Rotation Representations (CVPR
2019), for six numbers a rotation.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32, Int64
from scipy.spatial.transform import Rotation

from capture4d.errors import InputError
from capture4d.types import Body, PoseSequence
from retarget.config import ControlConfig

__all__ = ["ControlLayout", "ControlStream", "control_vectors", "garment_joints"]

RATE_TOLERANCE = 1e-3
"""Relative difference of two frame rates that are the same."""


def garment_joints(
    skin_weights: Float[np.ndarray, "verts joints"], parents: Int32[np.ndarray, " joints"], share: float
) -> tuple[int, ...]:
    """Joints that carry at least a share of the garment's weights, and those between them and the root; no root.

    A joint in between bends the garment without carrying it, where the skeleton has it split in two.
    """
    carried = skin_weights.sum(axis=0) / max(float(skin_weights.sum()), 1e-12)
    found = set()
    for joint in np.flatnonzero(carried >= share):
        above = int(joint)
        while above > 0:
            found.add(above)
            above = int(parents[above])
    return tuple(sorted(found))


@dataclass(frozen=True, slots=True)
class ControlLayout:
    """What stands in a control vector, and at which rate; part of every learned regressor, whose file has the units."""

    joint_names: tuple[str, ...]
    """Of the whole skeleton."""
    joints: tuple[int, ...]
    """The garment's."""
    fps: float
    config: ControlConfig
    parents: tuple[int, ...] = ()
    """Of the whole skeleton, the root's -1; needed for whole rotations only."""

    @staticmethod
    def create(
        body: Body, skin_weights: Float[np.ndarray, "verts joints"], fps: float, config: ControlConfig
    ) -> ControlLayout:
        """The layout of a garment's controls."""
        joints = garment_joints(skin_weights, body.parents, config.joint_share)
        return ControlLayout(body.joint_names, joints, fps, config, tuple(int(parent) for parent in body.parents))

    @property
    def rotation_sets(self) -> int:
        """How often the rotations of the garment's joints stand at the head of a control vector: 6 numbers a joint."""
        return 1 + self.config.whole_rotations

    @property
    def size(self) -> int:
        """Numbers of a control vector, without the history."""
        return sum(self.kinds)

    @property
    def kinds(self) -> tuple[int, ...]:
        """How many numbers there are of each unit: rotations, velocity, acceleration, gravity, turning, lags."""
        return tuple(size for _, size in self._parts)

    @property
    def _parts(self) -> list[tuple[tuple[str, int], int]]:
        """What stands in a control vector, in order: each name with the setting that decides it, how many numbers."""
        config, rotations = self.config, 6 * len(self.joints)
        parts = [(("rotations", 0), rotations)]
        if config.whole_rotations:
            parts.append((("whole rotations", 0), rotations))
        if config.root_motion:
            parts += [((name, config.derivative_frames), 3) for name in ("velocity", "acceleration")]
        if config.up:
            parts.append((("up", 0), 3))
        if config.joint_velocity:
            parts.append((("turning", 0), 3 * (len(self.joints) + 1)))
        lagging = "lag" if not config.whole_rotations else "lag with whole rotations"
        return [*parts, *(((lagging, lag), rotations * self.rotation_sets) for lag in config.lags)]

    @property
    def parts(self) -> list[tuple[str, slice, bool]]:
        """What stands in a control vector: name, where, and whether it says how things move, not how they are."""
        ends = np.cumsum([0, *self.kinds]).tolist()
        still = ("rotations", "whole rotations", "up")
        return [(name, slice(ends[i], ends[i + 1]), name not in still) for i, ((name, _), _) in enumerate(self._parts)]

    @property
    def pose_columns(self) -> Int64[np.ndarray, " poses"]:
        """Where a control vector says how things are; the garment's joints against their parents come first."""
        found = [np.arange(part.start, part.stop) for _, part, moves in self.parts if not moves]
        return np.concatenate(found).astype(np.int64)

    def columns_of(self, other: ControlLayout) -> Int64[np.ndarray, " controls"] | None:
        """Where another layout's controls stand in these; None: they are not all here."""
        if (self.joint_names, self.joints, self.fps) != (other.joint_names, other.joints, other.fps):
            return None
        starts = dict(zip((name for name, _ in self._parts), np.cumsum([0, *self.kinds]).tolist(), strict=False))
        if any(name not in starts for name, _ in other._parts):
            return None
        return np.concatenate([starts[name] + np.arange(size) for name, size in other._parts])

    def require(self, poses: PoseSequence) -> None:
        """
        Raises:
            InputError: the poses are of another skeleton or rate.
        """
        if poses.joint_names != self.joint_names:
            raise InputError(
                f"poses: expected the {len(self.joint_names)} joints of the model ({', '.join(self.joint_names[:4])}, "
                f"...), found {len(poses.joint_names)} ({', '.join(poses.joint_names[:4])}, ...)"
            )
        if abs(poses.fps - self.fps) > RATE_TOLERANCE * self.fps:
            raise InputError(f"poses: expected {self.fps:g} frames a second, as the model, found {poses.fps:g}")


class ControlStream:
    """Control vectors of frames as they come. Lags count frames; before the first, the first."""

    def __init__(self, layout: ControlLayout) -> None:
        self._layout = layout
        self._past: deque[tuple[float, np.ndarray]] = deque(maxlen=layout.config.derivative_frames)
        self._before: tuple[float, np.ndarray] | None = None
        self._turned: deque[np.ndarray] = deque(maxlen=max(layout.config.lags, default=0) + 1)

    def push(
        self, rotations: Float[np.ndarray, "joints 3 3"], translation: Float[np.ndarray, " 3"], time_s: float
    ) -> Float64[np.ndarray, " controls"]:
        """The control vector of the next frame.

        Args:
            time_s: any clock that frames share; a missing frame is a longer step.
        """
        config, joints = self._layout.config, list(self._layout.joints)
        local = rotations.astype(np.float64)
        self._past.append((time_s, translation.astype(np.float64)))
        turned = [local[joints]]
        if config.whole_rotations:
            turned.append(self._whole(local)[joints])
        parts = [(np.concatenate(turned) - np.eye(3))[:, :, :2].reshape(-1)]
        self._turned.append(parts[0])
        if config.root_motion:
            velocity, acceleration = _derivatives(self._past)
            parts += [local[0].T @ velocity, local[0].T @ acceleration]
        if config.up:
            parts.append(local[0].T @ np.array([0.0, 1.0, 0.0]))
        if config.joint_velocity:
            parts.append(self._turning(local[[0, *joints]], time_s))
        parts += [parts[0] - self._turned[max(len(self._turned) - 1 - lag, 0)] for lag in config.lags]
        return np.concatenate(parts)

    def _whole(self, local: np.ndarray) -> np.ndarray:
        """Rotations against the root, (J, 3, 3); only those of the garment's joints are right."""
        whole = np.tile(np.eye(3), (len(local), 1, 1))
        for joint in self._layout.joints:  # parents come first, and all but the root are among them
            whole[joint] = whole[self._layout.parents[joint]] @ local[joint]
        return whole

    def _turning(self, local: np.ndarray, time_s: float) -> np.ndarray:
        """Angular velocities since the frame before, radians a second, in each joint's own frame."""
        before, self._before = self._before, (time_s, local)
        if before is None:
            return np.zeros(3 * len(local))
        turned = np.swapaxes(before[1], 1, 2) @ local
        return (Rotation.from_matrix(turned).as_rotvec() / max(time_s - before[0], 1e-9)).reshape(-1)


def _derivatives(past: deque[tuple[float, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Velocity and acceleration at the last place, from a line through two or a parabola through more."""
    if len(past) < 2:
        return np.zeros(3), np.zeros(3)
    times = np.array([time - past[-1][0] for time, _ in past])
    scale = -times[0]
    degree = min(len(past) - 1, 2)
    terms = (times / scale)[:, None] ** np.arange(degree + 1)
    fitted = np.linalg.lstsq(terms, np.stack([place for _, place in past]), rcond=None)[0]
    acceleration = 2 * fitted[2] / scale**2 if degree == 2 else np.zeros(3)
    return fitted[1] / scale, acceleration


def control_vectors(layout: ControlLayout, poses: PoseSequence) -> Float32[np.ndarray, "frames controls"]:
    """Control vectors of a motion.

    Raises:
        InputError: the poses are of another skeleton or rate.
    """
    layout.require(poses)
    stream = ControlStream(layout)
    times = poses.frame_ids / poses.fps
    rows = [
        stream.push(rotations, translation, float(time))
        for rotations, translation, time in zip(poses.rotations, poses.translations, times, strict=True)
    ]
    return np.array(rows, np.float32).reshape(len(rows), layout.size)
