"""Learning a garment with styles from unposed drapes.

References: TailorNet (CVPR 2020), sections 4.3 and 4.4.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64

from capture4d.captures.animations.known_poses import PoseRange, nearest_poses, pose_quaternions
from capture4d.errors import InputError
from retarget.mixture.config import NetworkConfig, StylesConfig
from retarget.mixture.diffusion import Diffusion
from retarget.mixture.heads import Head, PoseNumbers
from retarget.mixture.kernel_ridge import KernelRidge, fit_kernel_ridge, fit_left_out
from retarget.mixture.lesson import PairDrapes, StyleLesson
from retarget.mixture.predictors import Ensemble, Mixture, Predictor, joined
from retarget.mixture.prototype_weights import (
    RELEASED_BANDWIDTH,
    effective_number,
    left_out_bandwidth,
    prototype_weights,
    squared_distances,
)
from retarget.mixture.styled_garment import Canonical, StyledGarment
from retarget.mixture.training import Examples, Trained, Trainer, said_by

__all__ = ["Learned", "learn_styles"]

Learned = tuple[StyledGarment, dict[str, Any], list[dict[str, Any]]]
"""A garment, what there is to say of how it was learned, and a row for every epoch."""


def learn_styles(lesson: StyleLesson, config: StylesConfig, folder: Path, *, threads: int = 1) -> Learned:
    """Learn from the prototypes of a lesson, in the poses that may be learned from.

    Args:
        folder: gets a checkpoint of each network, from which the same call goes on.
        threads: of torch; results are the same bits only for the same number.
    Raises:
        InputError: there is nothing to learn from, the loss is no number any more, or a checkpoint is damaged.
    """
    if config.method == "ensemble" and not (config.members or config.kernels):
        raise InputError("members, kernels: expected networks, kernels or both, found neither")
    with _threads(threads):
        return _Learning(lesson, config, folder).learned()


@contextmanager
def _threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class _Learning:
    """What the steps share."""

    def __init__(self, lesson: StyleLesson, config: StylesConfig, folder: Path) -> None:
        self.lesson, self.config = lesson, config
        self.train = Trainer(folder, config.checkpoint_every, config.seed)
        self.seen = [(pair, ~pair.unseen) for pair in lesson.prototypes]
        if not any(rows.any() for _, rows in self.seen):
            raise InputError("drapes: expected good ones of a prototype in poses to learn from, found none")
        self.checked_poses = self._checked_poses()
        rotations = np.concatenate([pair.rotations[rows] for pair, rows in self.seen])
        self.pose = PoseNumbers.create(
            lesson.body, lesson.skin_weights, rotations,
            kind=config.pose, share=config.joint_share, standardised=config.standardised,
        )  # fmt: skip
        self.history: list[dict[str, Any]] = []
        self.note: dict[str, Any] = {"joints": [lesson.body.joint_names[j] for j in self.pose.joints]}

    def learned(self) -> Learned:
        canonical = self._canonical()
        method = self._ensemble if self.config.method == "ensemble" else self._mixture
        lesson = self.lesson
        garment = StyledGarment(
            lesson.garment, lesson.body, lesson.ranges, self.pose, canonical, method(canonical),
            self.config.over == "drape", self._known_poses(),
        )  # fmt: skip
        return garment, self.note, self.history

    def _checked_poses(self) -> set[int]:
        """Poses that choose the epoch, the same for all pairs; at least one of them if there are three."""
        poses = np.unique(np.concatenate([pair.poses[rows] for pair, rows in self.seen]))
        count = round(self.config.validation * len(poses))
        if self.config.validation and len(poses) > 2:
            count = max(count, 1)
        rng = np.random.default_rng([self.config.seed, 11])
        return {int(pose) for pose in rng.choice(poses, count, replace=False)}

    def _known_poses(self) -> PoseRange:
        """The learned poses, each once, and how far those that chose the epoch were from the others."""
        poses, first = np.unique(np.concatenate([pair.poses[rows] for pair, rows in self.seen]), return_index=True)
        rotations = np.concatenate([pair.rotations[rows] for pair, rows in self.seen])[first]
        quaternions = pose_quaternions(rotations, self.pose.joints)
        checked = np.isin(poses, sorted(self.checked_poses))
        distances, _ = nearest_poses(quaternions[checked], quaternions[~checked])
        return PoseRange(quaternions, self.pose.joints, float(np.percentile(distances, 95)) if checked.any() else 0.0)

    def _checked(self, pair: PairDrapes, rows: Bool[np.ndarray, " drapes"]) -> Bool[np.ndarray, " drapes"]:
        return rows & np.isin(pair.poses, sorted(self.checked_poses))

    def _network(self, name: str, examples: Examples, config: NetworkConfig, seed: int = 0) -> Trained:
        trained = self.train(name, examples, config, seed=seed)
        self.history += trained.history
        return trained

    def _base(self, canonical: Canonical, pair: PairDrapes) -> Float64[np.ndarray, "verts 3"]:
        """What the displacements of a pair are over."""
        return pair.under + canonical(pair.numbers) if self.config.over == "drape" else pair.under

    # --- the A-pose ------------------------------------------------------------------------------------------------

    def _canonical(self) -> Canonical:
        """g."""
        lesson, config = self.lesson, self.config.canonical
        flat = lesson.pool.reshape(len(lesson.pool), -1)
        if config.kind == "kernel":
            regression, off = fit_left_out(lesson.pool_numbers, flat, lengths=config.lengths, ridges=config.ridges)
            self.note["a_pose"] = {
                "length": regression.length,
                "left_out_rms_mm": 1e3 * off / float(np.sqrt(flat.shape[1] / 3)),
            }
            return Canonical(regression, np.zeros(lesson.pool.shape[1:]))
        inputs, wanted = lesson.pool_numbers.astype(np.float32), flat.astype(np.float32)
        trained = self._network("a_pose", Examples(inputs, wanted, inputs[:0], wanted[:0]), config.network)
        self.note["a_pose"] = {"pool": len(flat)}
        return Canonical(trained.network, np.zeros(lesson.pool.shape[1:]))

    # --- networks and kernels over all pairs -----------------------------------------------------------------------

    def _examples(self, targets: Sequence[Float[np.ndarray, "drapes verts 3"]], head: Head) -> Examples:
        """Rows of all prototypes.

        Args:
            targets: displacements of every drape of each prototype.
        """
        parts: dict[bool, list[tuple[np.ndarray, np.ndarray]]] = {False: [], True: []}
        for (pair, rows), wanted in zip(self.seen, targets, strict=True):
            checked = self._checked(pair, rows)
            for which, chosen in ((False, rows & ~checked), (True, checked)):
                parts[which].append((joined(self.pose.of(pair.rotations[chosen]), pair.numbers),
                                     head.encoded(wanted[chosen])))  # fmt: skip
        inputs, wanted, shown, said = (
            np.concatenate([part[k] for part in parts[which]]) for which in (False, True) for k in (0, 1)
        )
        return Examples(inputs, wanted, shown, said)

    def _head(self, targets: Sequence[Float[np.ndarray, "drapes verts 3"]], config: NetworkConfig) -> Head:
        """Of what is learned from, the checked poses left out."""
        if config.heads == "vertices":
            return Head.of_vertices(targets[0].shape[1])
        shown = [
            wanted[rows & ~self._checked(pair, rows)] for (pair, rows), wanted in zip(self.seen, targets, strict=True)
        ]
        return Head.of_directions(np.concatenate(shown), config.directions)

    def _ensemble(self, canonical: Canonical) -> Predictor:
        config = self.config
        targets = [pair.unposed - self._base(canonical, pair) for pair, _ in self.seen]
        head = self._head(targets, config.network)
        examples = self._examples(targets, head)
        networks = [
            self._network(f"network-{k}", examples, config.network, seed=k).network for k in range(config.members)
        ]
        kernels = self._kernels(targets, head) if config.kernels else None
        self.note["directions"] = head.outputs
        return Ensemble(head, networks, kernels, config.kernel.style_weight)

    def _kernels(self, targets: Sequence[Float[np.ndarray, "drapes verts 3"]], head: Head) -> KernelRidge:
        """Kernels over all that may be learned from: they have nothing to stop."""
        config = self.config.kernel
        points = np.concatenate([
            joined(self.pose.of(pair.rotations[rows]), config.style_weight * pair.numbers) for pair, rows in self.seen
        ]).astype(np.float64)  # fmt: skip
        wanted = np.concatenate([head.encoded(each[rows]) for (_, rows), each in zip(self.seen, targets, strict=True)])
        centred = points - points.mean(axis=0)
        squares = 2 * float((centred**2).sum(axis=1).mean())  # mean squared distance of two rows
        length = max(float(np.sqrt(config.length * squares / 2)), 1e-9)
        return fit_kernel_ridge(points, wanted, length=length, ridge=config.ridge)

    # --- the mixture -----------------------------------------------------------------------------------------------

    def _mixture(self, canonical: Canonical) -> Predictor:
        lesson, config = self.lesson, self.config
        rest = lesson.pairs[0].canonical
        diffusion = Diffusion.create(lesson.garment.template.faces, rest, config.mixture.split)
        smooth = [diffusion.smooth(pair.unposed) for pair, _ in self.seen]
        low = [each - self._base(canonical, pair) for each, (pair, _) in zip(smooth, self.seen, strict=True)]
        high = [pair.unposed - each for each, (pair, _) in zip(smooth, self.seen, strict=True)]
        low_head, high_head = self._head(low, config.network), self._head(high, config.mixture.high)
        network = self._network("low", self._examples(low, low_head), config.network).network
        networks = [
            self._network(f"high-{k:02d}", self._of_one(k, high[k], high_head), config.mixture.high, seed=k).network
            for k in range(len(self.seen))
        ]
        prototypes = np.stack([canonical(pair.numbers) for pair, _ in self.seen])
        distances = squared_distances(prototypes, prototypes)
        bandwidth = RELEASED_BANDWIDTH
        if config.mixture.bandwidth == "left-out":
            bandwidth, errors = left_out_bandwidth(distances, *self._asked(networks, high, high_head))
            self.note["bandwidths"] = [{"bandwidth": each, "error": error} for each, error in errors]
        said = [effective_number(prototype_weights(row, bandwidth)) for row in distances]
        self.note |= {
            "bandwidth": bandwidth,
            "effective_prototypes": float(np.mean(said)),
            "smoothing": {"steps": diffusion.steps, "rate": diffusion.rate},
        }
        return Mixture(low_head, network, high_head, networks, prototypes, bandwidth, config.mixture.normalised)

    def _of_one(self, k: int, wanted: Float32[np.ndarray, "drapes verts 3"], head: Head) -> Examples:
        """Rows of one prototype, told by the pose alone."""
        pair, rows = self.seen[k]
        checked = self._checked(pair, rows)
        poses, codes = self.pose.of(pair.rotations), head.encoded(wanted)
        shown = rows & ~checked
        return Examples(poses[shown], codes[shown], poses[checked], codes[checked])

    def _asked(
        self, networks: Sequence[torch.nn.Sequential], high: Sequence[np.ndarray], head: Head
    ) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """What all networks say to the poses of each prototype, and what is true there."""
        said, truth = [], []
        for (pair, rows), wanted in zip(self.seen, high, strict=True):
            poses = self.pose.of(pair.rotations[rows])
            said.append(np.stack([said_by(network, poses) for network in networks]))
            truth.append(head.encoded(wanted[rows]))
        return said, truth
