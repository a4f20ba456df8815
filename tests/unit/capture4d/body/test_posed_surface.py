"""The body's answer to its parameters: compiled loops against slow and obvious ones."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import KDTree

from capture4d.body.posed_surface import (
    NORMAL_REACH_M,
    BodyState,
    PosedSurface,
    linearise,
    match,
    normal_equations,
    pose_surface,
    tracked_body,
)
from capture4d.body.surface_kernels import nearest_samples
from capture4d.geometry.point_grid import PointGrid
from capture4d.types import Body, Mesh


def limb(rng: np.random.Generator, joints: int = 5) -> Body:
    """A tube along x, its joints in a row but for the last one, which branches off the first."""
    around = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    along = np.linspace(0, 1, 30)
    x, angle = (grid.ravel() for grid in np.meshgrid(along, around, indexing="ij"))
    vertices = np.column_stack([x, 0.1 * np.cos(angle), 0.1 * np.sin(angle)]).astype(np.float32)
    at = np.arange(29 * 12).reshape(29, 12)
    onward, beside = at + 12, np.roll(at, -1, axis=1)
    faces = np.concatenate(
        [np.stack([at, beside, onward], -1).reshape(-1, 3), np.stack([beside, beside + 12, onward], -1).reshape(-1, 3)]
    ).astype(np.int32)
    parents = np.array([-1, *range(joints - 2), 0], np.int32)
    places = np.column_stack([np.linspace(0, 0.9, joints), np.zeros((joints, 2))]).astype(np.float32)
    weights = np.maximum(0, 1 - 4 * np.abs(vertices[:, None, 0] - places[None, :, 0])).astype(np.float32)
    weights[:, 0] += 1e-3
    weights /= weights.sum(axis=1, keepdims=True)
    return Body(
        template=Mesh(vertices, faces),
        joint_names=tuple(f"joint_{n}" for n in range(joints)),
        parents=parents,
        joints=places,
        skin_weights=weights,
        shape_directions=(0.02 * rng.normal(size=(3, len(vertices), 3))).astype(np.float32),
        joint_directions=(0.02 * rng.normal(size=(3, joints, 3))).astype(np.float32),
    )


def some_surface(rng: np.random.Generator) -> PosedSurface:
    model = tracked_body(limb(rng), samples=600)
    rest = model.rest_state()
    step = 0.3 * rng.normal(size=3 + 3 * len(rest.rotations) + len(rest.shape))
    return pose_surface(model, rest.moved(step))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("with_shape", [True, False])
def test_normal_equations_are_those_of_the_rows(seed: int, with_shape: bool) -> None:
    rng = np.random.default_rng(seed)
    surface = some_surface(rng)
    points = surface.vertices[rng.permutation(len(surface.vertices))[:200]] + 0.02 * rng.normal(size=(200, 3))
    matches = match(surface, points, np.zeros((200, 3)))
    weight = np.where(rng.random(200) < 0.3, 0.0, rng.random(200))
    residual = rng.normal(size=200)
    rows = linearise(surface, matches, np.ones(200, bool))
    rows = rows if with_shape else rows[:, : -len(surface.model.body.shape_directions)]
    information, descent = normal_equations(surface, matches, weight, residual, with_shape=with_shape)
    np.testing.assert_allclose(information, rows.T @ (weight[:, None] * rows), atol=1e-10)
    np.testing.assert_allclose(descent, rows.T @ (weight * residual), atol=1e-10)


def test_rows_are_derivatives() -> None:
    rng = np.random.default_rng(4)
    model = tracked_body(limb(rng), samples=600)
    rest = model.rest_state()
    state = rest.moved(0.3 * rng.normal(size=3 + 3 * len(rest.rotations) + len(rest.shape)))
    surface = pose_surface(model, state)
    matches = match(surface, surface.vertices[::7] + 0.01, np.zeros((len(surface.vertices[::7]), 3)))
    rows = linearise(surface, matches, np.ones(len(matches.faces), bool))

    def along(moved: BodyState) -> np.ndarray:
        corners = pose_surface(model, moved).vertices[model.body.template.faces[matches.faces]]
        places = np.einsum("nca,nc->na", corners, matches.barycentric)
        return np.einsum("na,na->n", places, matches.normals)

    for parameter in range(rows.shape[1]):
        step = np.zeros(rows.shape[1])
        step[parameter] = 1e-5
        slope = (along(state.moved(step)) - along(state.moved(-step))) / 2e-5
        np.testing.assert_allclose(rows[:, parameter], slope, atol=1e-7)


@pytest.mark.parametrize("spread_m", [0.01, 0.4])
def test_nearest_samples_are_those_of_a_tree(spread_m: float) -> None:
    """Near and far ones: while a pose is searched for, points lie far off."""
    rng = np.random.default_rng(5)
    places, queries = rng.random((900, 3)), rng.random((400, 3)) + spread_m * rng.normal(size=(400, 3))
    turned, directions = (each / np.linalg.norm(each, axis=1)[:, None] for each in rng.normal(size=(2, 900, 3)))
    turned = turned[:400]
    grid = PointGrid.build(places, 0.1)
    found = nearest_samples(
        queries, turned, 3, NORMAL_REACH_M,
        grid.origin, grid.cell, grid.shape, grid.starts, grid.points, directions[grid.order],
    )  # fmt: skip
    tree = KDTree(np.hstack([places, NORMAL_REACH_M * directions]))
    wanted = tree.query(np.hstack([queries, NORMAL_REACH_M * turned]), k=3)[1]
    np.testing.assert_array_equal(grid.order[found], wanted)
