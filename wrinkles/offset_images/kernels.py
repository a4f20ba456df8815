"""Offsets by kernel regression on poses: a baseline, a partner, and a first guess that a decoder adds to.

Each frame that was learned from counts as much as its pose is like the one that is asked for. Jin et al. have none to
compare with; with few frames they are hard to beat. They know their own frames by heart, so a network that adds to them
must learn from guesses of which the frame itself was left out. Those are exact here: they follow from the inverse.

Letters: N frames, D numbers of a pose, K principal components of the offsets, P cloth pixels.

References: Rasmussen and Williams, Gaussian Processes for Machine Learning (MIT Press, 2006), sections 2.2 and 5.4.2.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64
from scipy.spatial.distance import pdist
from torch import Tensor

from capture4d.learning.kernels import left_out_errors, likeness, ridge_answers
from wrinkles.offset_images.frames import OffsetFrames
from wrinkles.offset_images.networks import principal_offsets

__all__ = ["PoseKernels", "fit_kernels"]

WIDTHS = (0.5, 0.7, 1.0, 1.4, 2.0, 2.8)
"""Of the kernel, in median distances between poses."""
RIDGES = (1e-4, 1e-3, 1e-2, 1e-1)
LINES = (0.0, 0.1)
"""Weights of the linear kernel beside 1 of the Gaussian one."""
MOST_TO_CHOOSE = 600
"""Frames on which width, ridge and line are chosen."""
COMPONENTS = 512


@dataclass(frozen=True, slots=True, eq=False)
class PoseKernels:
    """A regression from poses to offsets, centimetres."""

    poses: Float32[np.ndarray, "N D"]
    answers: Float32[np.ndarray, "N K"]
    """What each frame contributes."""
    mean: Float32[np.ndarray, " values"]
    basis: Float32[np.ndarray, "K values"]
    """Orthonormal directions of offsets, 3 P values each."""
    width: float
    line: float

    def offsets(self, pose: Float[Tensor, "frames D"]) -> Float[Tensor, "frames P 3"]:
        """Offsets of all cloth pixels in other poses."""
        alike = _alike(pose.numpy(), self.poses, self.width, self.line)
        made = self.mean + (alike @ self.answers).astype(np.float32) @ self.basis
        return torch.from_numpy(made.astype(np.float32)).unflatten(1, (-1, 3))


def fit_kernels(frames: OffsetFrames) -> tuple[PoseKernels, Float[Tensor, "N P 3"]]:
    """Learn frames by kernels whose width, ridge and line foretell left-out frames best.

    Returns:
        The regression, and what it gives each frame when that frame alone is left out, exactly.
    """
    mean, basis, _ = principal_offsets(frames.offsets, COMPONENTS)
    poses = frames.pose.numpy()
    wanted = ((frames.offsets.flatten(1) - mean) @ basis.T).double().numpy()
    some = np.random.default_rng(0).permutation(len(poses))[:MOST_TO_CHOOSE]
    width, line, ridge = min(_choices(poses[some], wanted[some]), key=lambda each: each[1])[0]
    alike = _alike(poses, poses, width, line)
    answers = next(ridge_answers(alike, wanted, [ridge]))
    left_out = wanted - left_out_errors(alike, wanted, ridge)
    guessed = (mean + torch.from_numpy(left_out).float() @ basis).unflatten(1, (-1, 3))
    kernels = PoseKernels(poses, answers.astype(np.float32), mean.numpy(), basis.numpy(), width, line)
    return kernels, guessed


def _choices(poses: np.ndarray, wanted: np.ndarray) -> Iterator[tuple[tuple[float, float, float], float]]:
    """Width, line and ridge, and the mean square that they leave of frames that are left out."""
    distances = pdist(poses[:200]) if len(poses) > 1 else np.ones(1)
    usual = float(np.median(distances)) or 1.0
    for share, line in product(WIDTHS, LINES):
        alike = _alike(poses, poses, share * usual, line)
        for ridge in RIDGES:
            yield (share * usual, line, ridge), float(np.square(left_out_errors(alike, wanted, ridge)).mean())


def _alike(ours: np.ndarray, theirs: np.ndarray, width: float, line: float) -> Float64[np.ndarray, "rows others"]:
    views = [(each / width).astype(np.float64) for each in (ours, theirs)]
    return likeness(views[:1], views[1:], np.ones(1), line)
