"""Two segments of a take joined: what a seam is like, and the frames in which one fades into the other.

Both have registered the last frames before the seam. What cloth has slid without a trace the later one cannot know,
and how folds have locked differs, so that the two lie 1 to 3 mm apart along the cloth, each as near to the truth as the
other, and stay so. Going over from one to the other at once would be a jump of that size; blended over some frames it
adds a tenth of a millimetre to the motion of each. Both lie on the scan, and cloth is flat over a few millimetres, so
the blend lies there, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

__all__ = ["Seam", "blended", "faded", "seam_of", "share_of_later"]


@dataclass(frozen=True, slots=True)
class Seam:
    """How two segments go together."""

    step_mm: float | None
    """What blending adds to a frame's motion, mean over the vertices, of the frame where that is most; None where no
    frame is sound in both."""
    continues: bool
    """They are too far apart to be blended: the later one has to be registered anew, from the earlier one's end."""


def faded(overlap: int) -> int:
    """How many frames before a seam are blended: the last two thirds of those that both segments have; in the first
    third the later one still finds its way."""
    return overlap - overlap // 3


def share_of_later(at: int, count: int) -> float:
    """Share of the later segment in the `at`-th of `count` blended frames, from 0 on."""
    return (at + 1) / (count + 1)


def seam_of(
    before: Sequence[tuple[Float32[np.ndarray, "verts 3"], bool]],
    after: Sequence[tuple[Float32[np.ndarray, "verts 3"], bool]],
    largest_step_mm: float,
) -> Seam:
    """Compare two segments in the frames that are to be blended.

    Args:
        before: vertices of the earlier segment, metres, and whether they are sound, frame by frame.
        after: the same of the later one.
        largest_step_mm: that blending may add to a frame's motion.
    """
    steps = [
        step_mm(first, second, len(before))
        for (first, first_sound), (second, second_sound) in zip(before, after, strict=True)
        if first_sound and second_sound
    ]
    can_continue = any(sound for _, sound in before)
    if not steps:
        return Seam(None, can_continue and not any(sound for _, sound in after))
    return Seam(max(steps), can_continue and max(steps) > largest_step_mm)


def step_mm(before: Float32[np.ndarray, "verts 3"], after: Float32[np.ndarray, "verts 3"], count: int) -> float:
    """What blending over `count` frames adds to the motion of one, mean over the vertices, millimetres."""
    return 1e3 * float(np.linalg.norm(after - before, axis=1).mean()) / (count + 1)


def blended(
    before: Float32[np.ndarray, "verts 3"], after: Float32[np.ndarray, "verts 3"], share: float
) -> Float32[np.ndarray, "verts 3"]:
    """A share of the later segment, and the rest of the earlier one."""
    start = before.astype(np.float64)
    return (start + share * (after - start)).astype(np.float32)
