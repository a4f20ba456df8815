"""Rigid pre-alignment of a template to a scan, with scale when asked for: principal axes, then ICP from each guess.

Principal axes leave the signs open, and for round shapes the order too; every proper rotation among them is a start,
a few cheap ICP steps tell which are worth finishing.

References: Besl and McKay 1992 (ICP); Umeyama 1991 (similarity from point pairs); Chetverikov 2002 (trimming).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from jaxtyping import Float64
from scipy.spatial import KDTree

__all__ = ["Similarity", "align", "fit_similarity"]

SAMPLES = 2000
"""Points of either side that take part."""
THINNED = 2
"""One in so many of the template's is enough to tell which guesses are worth finishing; one in four is not always."""
STILL = 1e-5
"""Change of a rotation's entries and of a place, metres for a template of 1.2 m, at which nothing more is to come."""
TRIM = 0.85
"""Share of the closest pairs that count: the scan may show more or less than the template."""
AS_NEAR = 1.1
"""Of two results whose distances differ by less than this factor the one that turns less counts: a shirt turned back to
front lies as near to a moving one as the shirt itself."""


@dataclass(frozen=True, slots=True, eq=False)
class Similarity:
    """x -> scale R x + t."""

    rotation: Float64[np.ndarray, "3 3"]
    translation: Float64[np.ndarray, "3"]
    scale: float = 1.0

    def apply(self, points: Float64[np.ndarray, "points 3"]) -> Float64[np.ndarray, "points 3"]:
        return self.scale * np.einsum("ab,pb->pa", self.rotation, points) + self.translation


def fit_similarity(
    source: Float64[np.ndarray, "points 3"], target: Float64[np.ndarray, "points 3"], *, with_scale: bool
) -> Similarity:
    """The best similarity, in least squares, from point pairs; a rotation without reflection."""
    centre, aim = source.mean(axis=0), target.mean(axis=0)
    spread = np.einsum("pa,pb->ab", target - aim, source - centre)
    left, strength, right = np.linalg.svd(spread)
    proper = np.array([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    rotation = np.einsum("ab,b,bc->ac", left, proper, right)
    variance = ((source - centre) ** 2).sum()
    scale = float((strength * proper).sum() / variance) if with_scale and variance > 0 else 1.0
    return Similarity(rotation, aim - scale * np.einsum("ab,b->a", rotation, centre), scale)


def align(
    template: Float64[np.ndarray, "verts 3"], scan: Float64[np.ndarray, "points 3"], *, with_scale: bool
) -> Similarity:
    """Move the template onto the scan.

    The start as given is one of the guesses, so that a pair that is already aligned stays so; and what turns less is
    preferred to what is hardly nearer.
    """
    rng = np.random.default_rng(0)
    source = template[np.sort(rng.permutation(len(template))[:SAMPLES])]
    target = scan[np.sort(rng.permutation(len(scan))[: 4 * SAMPLES])]
    tree = KDTree(target)
    guesses = [Similarity(np.eye(3), np.zeros(3)), *_axis_guesses(source, target, with_scale)]
    tried = [_icp(guess, source[::THINNED], target, tree, with_scale, steps=8) for guess in guesses]
    unturned, others = tried[:2], sorted(tried[2:], key=lambda pair: pair[0])[:3]
    finished = [_icp(guess, source, target, tree, with_scale, steps=60) for _, guess in (*unturned, *others)]
    nearest = min(distance for distance, _ in finished)
    return max((found for distance, found in finished if distance <= AS_NEAR * nearest), key=_unturned)


def _unturned(motion: Similarity) -> float:
    """Trace of the rotation: 3 if it does not turn, -1 by half a turn."""
    return float(np.trace(motion.rotation))


def _axis_guesses(source: np.ndarray, target: np.ndarray, with_scale: bool) -> list[Similarity]:
    centre, aim = source.mean(axis=0), target.mean(axis=0)
    radius, aim_radius = (np.sqrt(((p - p.mean(axis=0)) ** 2).sum(axis=1).mean()) for p in (source, target))
    scale = float(aim_radius / radius) if with_scale and radius > 0 else 1.0
    axes, aim_axes = (np.linalg.svd(p - p.mean(axis=0), full_matrices=False)[2].T for p in (source, target))
    found = [Similarity(np.eye(3), aim - scale * centre, scale)]
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            rotation = np.einsum("ab,b,cb->ac", aim_axes[:, order], np.array(signs), axes)
            if np.linalg.det(rotation) > 0:
                found.append(Similarity(rotation, aim - scale * np.einsum("ab,b->a", rotation, centre), scale))
    return found


def _icp(
    guess: Similarity, source: np.ndarray, target: np.ndarray, tree: KDTree, with_scale: bool, *, steps: int
) -> tuple[float, Similarity]:
    """Trimmed ICP; the symmetric trimmed distance that is left, and the result."""
    current = guess
    kept = max(4, int(TRIM * len(source)))
    for _ in range(steps):
        moved = current.apply(source)
        distance, nearest = map(np.asarray, tree.query(moved))
        close = np.argpartition(distance, kept - 1)[:kept]
        step = fit_similarity(source[close], target[nearest[close]], with_scale=with_scale)
        change = np.abs(step.rotation - current.rotation).max() + np.abs(step.translation - current.translation).max()
        current = step
        if change < STILL:
            break
    moved = current.apply(source)
    there = np.sort(np.asarray(tree.query(moved)[0]))[:kept]
    back = np.sort(np.asarray(KDTree(moved).query(target[::4])[0]))
    return float(there.mean() + back[: max(1, int(TRIM * len(back)))].mean()), current
