"""A garment shrunk onto a body, so that every vertex has a body point and neighbours have neighbouring ones.

1. `morph`: the cage is moved onto the body; the displacements inside are harmonic (`Extension`).
2. `push_out`: what is inside the body is moved to its nearest surface point, by the signed distance.
3. `equalise`: on the surface, springs even out by how much the edges at a vertex are stretched. With the mean ratio
   alpha_v of the edges at v to their rest lengths, the target length of an edge (a, b) is
   (alpha_a + alpha_b) / 2 times its rest length.

The map is not one to one: a collar's two layers and the chest under it may have one body point, which nothing here or
later inverts.

Letters: V vertices, F faces, E edges.

References: Jin et al., A pixel-based framework for data-driven clothing, SCA 2020, appendix D.5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int32, Integer

from capture4d.geometry.cages.dirichlet import Extension
from capture4d.geometry.mesh import doubled_area_vectors, edge_lengths, unique_edges, vertex_adjacency
from capture4d.geometry.ray_casting import Nearest, TriangleScene, barycentric

__all__ = [
    "OnSurface",
    "edge_ratio_spread",
    "equalise",
    "flipped_faces",
    "morph",
    "on_surface",
    "push_out",
    "turned_in_faces",
]

STEP = 1.2
"""Of the way that the springs at a vertex want in the mean; half of each spring's fault is either end's. 2 would be too
far for alternating faults."""
LOOK_EVERY = 20
"""Iterations between two looks at whether the spread still falls."""
STILL_FALLS = 0.002
"""Share by which it has to fall in between."""
OUTLYING = 2.5
"""Ratios beyond so many medians count as that in the mean at a vertex. The formula feeds itself where a short edge lies
pulled apart by a factor of thirty, as in the folds of a cuff: all others at its ends would have to stretch like it."""
TURNS_BACK = 4
"""How often vertices of faces that would turn over are taken back in one iteration."""


@dataclass(frozen=True, slots=True, eq=False)
class OnSurface:
    """Vertices on a body's surface."""

    points: Float64[np.ndarray, "V 3"]
    faces: Int32[np.ndarray, " V"]
    """Of the body."""
    barycentric: Float64[np.ndarray, "V 3"]
    normals: Float64[np.ndarray, "V 3"]
    """Of the body's faces."""


def on_surface(scene: TriangleScene, points: Float[np.ndarray, "V 3"]) -> OnSurface:
    """The nearest point of the surface to each point. It is no farther than rounding from where it is named."""
    found: Nearest = scene.nearest(points)
    within = np.clip(barycentric(found.uv).astype(np.float64), 0.0, 1.0)
    within /= within.sum(axis=1, keepdims=True)
    return OnSurface(found.points.astype(np.float64), found.faces, within, found.normals.astype(np.float64))


def morph(
    vertices: Float[np.ndarray, "V 3"], extension: Extension, targets: Float[np.ndarray, "C 3"]
) -> Float64[np.ndarray, "V 3"]:
    """Step 1: the cage goes to its targets, everything else moves harmonically with it."""
    start = np.asarray(vertices, np.float64)
    return start + extension(targets - start[extension.cage])


def push_out(scene: TriangleScene, points: Float[np.ndarray, "V 3"]) -> Float64[np.ndarray, "V 3"]:
    """Step 2: points inside the closed surface move to its nearest point, the others stay."""
    pushed = np.array(points, np.float64)
    inside = scene.signed_distances(pushed) < 0
    pushed[inside] = scene.nearest(pushed[inside]).points
    return pushed


def equalise(
    scene: TriangleScene,
    points: Float[np.ndarray, "V 3"],
    faces: Integer[np.ndarray, "F 3"],
    rest_lengths: Float[np.ndarray, " E"],
    *,
    turned_in: Bool[np.ndarray, " F"],
    iterations: int,
) -> OnSurface:
    """Step 3: springs with the target lengths above, every vertex on the surface all the time.

    Faces that lie turned over, but were not turned in before, are unfolded: their corners move half way to the middle
    of their neighbours. Faces that a step would turn over keep their corners where they were. Ends when the spread of
    the edges' ratios falls no more, and gives back the vertices where it was least.

    Args:
        rest_lengths: of `unique_edges(faces)`.
        turned_in: faces of layers that are meant to face the body's inside (`turned_in_faces`).
        iterations: at most.
    """
    edges = unique_edges(faces)
    degree = np.maximum(np.bincount(edges.ravel(), minlength=len(points)), 1)
    rest = np.maximum(rest_lengths, 1e-9)
    adjacency = vertex_adjacency(faces, len(points))
    now = on_surface(scene, points)
    outwards = _outwards(now, faces)
    sides, best, least = outwards * _sides(now, faces), now, np.inf
    for iteration in range(iterations + 1):
        ratios = edge_lengths(now.points, edges) / rest
        if iteration % LOOK_EVERY == 0 or iteration == iterations:
            spread = _spread(ratios)
            falls = spread < (1 - STILL_FALLS) * least
            if spread < least:
                best, least = now, spread
            if not falls or iteration == iterations:
                break
        steps = STEP * _spring_steps(now.points, edges, rest, ratios, degree)
        folded = np.unique(faces[(sides <= 0) & ~turned_in])
        steps[folded] = 0.5 * (adjacency[folded] @ now.points / degree[folded, None] - now.points[folded])
        moved = on_surface(scene, now.points + steps)
        now, sides = _without_turns(now, moved, sides, faces, outwards)
    return best


def edge_ratio_spread(
    points: Float[np.ndarray, "V 3"], faces: Integer[np.ndarray, "F 3"], rest_lengths: Float[np.ndarray, " E"]
) -> float:
    """Standard deviation of the edges' ratios to their rest lengths, over their mean: shrinking counts nothing."""
    return _spread(edge_lengths(np.asarray(points, np.float64), unique_edges(faces)) / np.maximum(rest_lengths, 1e-9))


def turned_in_faces(
    scene: TriangleScene, vertices: Float[np.ndarray, "V 3"], faces: Integer[np.ndarray, "F 3"]
) -> Bool[np.ndarray, " F"]:
    """Faces that look the other way than most do, seen from the nearest body points: those of a turned-in hem, a
    collar's lower layer, a fold."""
    placed = on_surface(scene, vertices)
    placed = OnSurface(np.asarray(vertices, np.float64), placed.faces, placed.barycentric, placed.normals)
    return flipped_faces(placed, faces)


def flipped_faces(placed: OnSurface, faces: Integer[np.ndarray, "F 3"]) -> Bool[np.ndarray, " F"]:
    """Faces that look the other way on the body than most do."""
    return _outwards(placed, faces) * _sides(placed, faces) <= 0


def _spread(ratios: np.ndarray) -> float:
    return float(ratios.std() / max(ratios.mean(), 1e-12))


def _spring_steps(
    points: np.ndarray, edges: np.ndarray, rest: np.ndarray, ratios: np.ndarray, degree: np.ndarray
) -> np.ndarray:
    """The mean over the edges at each vertex of half of what each lacks or has too much."""
    start, end = edges.T
    count = len(points)
    median = np.median(ratios)
    counted = np.clip(ratios, median / OUTLYING, median * OUTLYING)
    alpha = (np.bincount(start, counted, count) + np.bincount(end, counted, count)) / degree
    goal = 0.5 * (alpha[start] + alpha[end])
    pull = 0.5 * (1.0 - goal / np.maximum(ratios, 1e-9))[:, None] * (points[end] - points[start])
    return (
        np.stack(
            [np.bincount(start, pull[:, k], count) - np.bincount(end, pull[:, k], count) for k in range(3)], axis=1
        )
        / degree[:, None]
    )


def _outwards(placed: OnSurface, faces: np.ndarray) -> float:
    """-1 of a mesh that is wound inside out."""
    return 1.0 if (_sides(placed, faces) > 0).mean() >= 0.5 else -1.0


def _sides(placed: OnSurface, faces: np.ndarray) -> np.ndarray:
    """Cosine of the angle between each face and the body under it, by sign and more or less."""
    normals = placed.normals[faces].sum(axis=1)
    return np.einsum("fa,fa->f", doubled_area_vectors(placed.points, faces), normals)


def _without_turns(
    before: OnSurface, after: OnSurface, sides: np.ndarray, faces: np.ndarray, outwards: float
) -> tuple[OnSurface, np.ndarray]:
    """After a step, but for the corners of faces that it would turn over."""
    back = np.zeros(len(before.points), bool)
    placed, found = after, outwards * _sides(after, faces)
    for _ in range(TURNS_BACK):
        turned = (sides > 0) & (found <= 0)
        if not turned.any():
            break
        back[faces[turned]] = True
        one = back[:, None]
        placed = OnSurface(
            np.where(one, before.points, after.points),
            np.where(back, before.faces, after.faces),
            np.where(one, before.barycentric, after.barycentric),
            np.where(one, before.normals, after.normals),
        )
        found = outwards * _sides(placed, faces)
    return placed, found
