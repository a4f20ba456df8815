"""Walks that are repeated find what walks find, to the bit, wherever the points have moved meanwhile."""

import numpy as np
import pytest
import trimesh

from capture4d.body.limb_walks import Walks, face_rows, walk, walk_again
from capture4d.geometry.mesh import vertex_normals
from tests.shapes import tube


def fans_of(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    corners = faces.reshape(-1)
    offsets = np.concatenate([[0], np.cumsum(np.bincount(corners, minlength=count))])
    return offsets, (np.argsort(corners, kind="stable") // 3).astype(np.int32)


def surface(kind: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Round, with creases, and with faces that have no area."""
    if kind == "tube":
        mesh = tube(24, 30, radius=0.1, height=0.6)
        vertices, faces = mesh.vertices.astype(np.float64), mesh.faces
    else:
        ball = trimesh.creation.icosphere(3)
        vertices, faces = 0.15 * np.array(ball.vertices), np.array(ball.faces, np.int32)
        vertices *= 1 + 0.3 * np.sin(6 * np.arctan2(vertices[:, 1], vertices[:, 0]))[:, None]
    if kind == "needles":
        for face in rng.choice(len(faces), 60, replace=False):
            a, b, c = faces[face]
            vertices[c] = 0.4 * vertices[a] + 0.6 * vertices[b]
    return vertices, faces


def blended(values: np.ndarray, corners: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Of three corners, added up in their order."""
    first, second, third = (weights[:, [k]] * values[corners[:, k]] for k in range(3))
    return first + second + third


@pytest.mark.parametrize("kind", ["tube", "creased", "needles"])
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("step_m", [0.0, 1e-7, 2e-4, 1e-3, 3e-3, 2e-2])
def test_a_walk_that_is_repeated_is_the_walk(kind: str, seed: int, step_m: float) -> None:
    """Through steps of all sizes, of points inside and outside, some of them over edges and corners."""
    rng = np.random.default_rng(seed)
    vertices, faces = surface(kind, rng)
    offsets, fans = fans_of(faces, len(vertices))
    under = rng.integers(0, len(vertices), 400)
    starts = fans[offsets[under]]
    points = vertices[under] * rng.uniform(0.8, 1.3, (400, 1))
    points[200:] += 0.02 * rng.standard_normal((200, 3))
    normals = vertex_normals(vertices, faces)
    known, (rows, needles) = Walks(900, len(faces)), face_rows(vertices, normals, faces)
    numbers = rng.permutation(900)[:400]
    for _ in range(8):
        wanted, weights = walk(points, starts, rows, faces, offsets, fans)
        heights, directions, feet, found = walk_again(
            points, numbers, starts, rows, needles, faces, offsets, fans, *known.arrays
        )
        np.testing.assert_array_equal(found, wanted)
        np.testing.assert_array_equal(feet, blended(vertices, faces[wanted], weights))
        outwards = blended(normals, faces[wanted], weights)
        outwards /= np.maximum(np.linalg.norm(outwards, axis=1, keepdims=True), 1e-12)
        np.testing.assert_allclose(directions, outwards, rtol=0, atol=1e-15)
        inside = np.einsum("px,px->p", points - feet, outwards) < 0
        distance = np.linalg.norm(points - feet, axis=1)
        np.testing.assert_allclose(heights, np.where(inside, -distance, distance), rtol=0, atol=1e-15)
        points = points + step_m * rng.standard_normal(points.shape) * (rng.random((400, 1)) < 0.8)
        moved = rng.choice(400, 20, replace=False)
        starts[moved] = fans[offsets[rng.integers(0, len(vertices), 20)]]
    if kind != "needles" and step_m <= 2e-4:
        assert known.walked[0] < 1600, "most of 3200 are repeated from what is remembered"


def test_faces_without_height_are_told() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1e-6, 0], [0.5, 0.1, 0], [0.5, 0.0, 0.0]], np.float64)
    faces = np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4], [3, 3, 0]], np.int32)
    needles = face_rows(vertices, np.zeros_like(vertices), faces)[1]
    np.testing.assert_array_equal(needles, [True, False, True, True])
