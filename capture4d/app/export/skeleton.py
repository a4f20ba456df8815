"""A body's skeleton as an engine wants it: four influences a vertex, no joints that move nothing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int32
from scipy.spatial.transform import Rotation

from capture4d.body.skinning import ShapedBody, with_pose
from capture4d.mesh_files.gltf.animated_scene import SceneSkin
from capture4d.types import PoseSequence

__all__ = ["Skeleton", "four_influences"]

INFLUENCES = 4


@dataclass(frozen=True, slots=True, eq=False)
class Skeleton:
    """The joints that a garment hangs from, in every frame. T frames, J joints of the body, j of the skeleton."""

    person: ShapedBody
    kept: Int32[np.ndarray, " kept"]
    """Joints of the body that are in the skeleton, ascending."""
    quaternions: Float32[np.ndarray, "frames joints 4"]
    """As they are written, rounded; those of all joints of the body."""
    root_places: Float32[np.ndarray, "frames 3"]
    weights: Float32[np.ndarray, "verts kept"]
    """At most four of a vertex."""

    @staticmethod
    def create(person: ShapedBody, poses: PoseSequence, skin_weights: Float32[np.ndarray, "verts joints"]) -> Skeleton:
        """Cut the weights to four a vertex, and leave out what nothing hangs from.

        Args:
            poses: of the frames that are exported, in their order.
        """
        cut = four_influences(skin_weights)
        parents = person.body.parents
        wanted: np.ndarray = np.asarray(cut.max(axis=0) > 0)
        for joint in range(len(parents) - 1, 0, -1):
            wanted[parents[joint]] |= wanted[joint]
        wanted[0] = True
        kept = np.flatnonzero(wanted).astype(np.int32)
        frames, joints = poses.rotations.shape[:2]
        turns = Rotation.from_matrix(poses.rotations.reshape(-1, 3, 3).astype(np.float64)).as_quat()
        turns = turns.reshape(frames, joints, 4)
        flips = np.where(np.einsum("tjq,tjq->tj", turns[1:], turns[:-1]) < 0, -1.0, 1.0)
        turns[1:] *= np.cumprod(flips, axis=0)[..., None]  # which way round is of no meaning, until it is interpolated
        places = (person.joints[0] + poses.translations).astype(np.float32)
        return Skeleton(person, kept, turns.astype(np.float32), places, cut[:, kept])

    def transforms(self, frame: int) -> Float64[np.ndarray, "kept 4 4"]:
        """Rest pose to world, of the joints that were kept, as a client computes them from what is written."""
        rotations = Rotation.from_quat(self.quaternions[frame]).as_matrix()
        return with_pose(self.person, rotations, self.root_places[frame] - self.person.joints[0]).transforms[self.kept]

    def scene_skin(self) -> SceneSkin:
        """As a glTF file has it."""
        body, number = self.person.body, {int(joint): at for at, joint in enumerate(self.kept)}
        order = np.argsort(-self.weights, axis=1, kind="stable")[:, :INFLUENCES]
        order = np.pad(order, ((0, 0), (0, INFLUENCES - order.shape[1])))
        weights = np.take_along_axis(self.weights, order, axis=1)
        weights[:, self.weights.shape[1] :] = 0  # a skeleton of fewer than four joints
        return SceneSkin(
            names=[body.joint_names[joint] for joint in self.kept],
            parents=[number.get(int(body.parents[joint]), -1) for joint in self.kept],
            rest=self.person.joints[self.kept].astype(np.float32),
            quaternions=self.quaternions[:, self.kept],
            root_places=self.root_places,
            joints=np.where(weights > 0, order, 0).astype(np.int32),
            weights=weights,
        )


def four_influences(skin_weights: Float32[np.ndarray, "verts joints"]) -> Float32[np.ndarray, "verts joints"]:
    """The four largest weights of each vertex, which add up to 1; the others 0."""
    if skin_weights.shape[1] <= INFLUENCES:
        return skin_weights
    order = np.argsort(-skin_weights, axis=1, kind="stable")[:, :INFLUENCES]
    largest = np.take_along_axis(skin_weights, order, axis=1).astype(np.float64)
    cut = np.zeros(skin_weights.shape, np.float32)
    np.put_along_axis(cut, order, (largest / largest.sum(axis=1, keepdims=True)).astype(np.float32), axis=1)
    return cut
