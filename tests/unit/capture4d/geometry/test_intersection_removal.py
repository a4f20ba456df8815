"""Cloth over a ball: everything about it is known, so depths, edges and what is left can be told by hand."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.geometry.intersection_removal import Contacts, IntersectionRemoval, Penetration, project, sweep_order
from capture4d.geometry.mesh import edge_lengths, edge_stretch, stretch_p99, unique_edges, vertex_adjacency
from tests.shapes import tube


@dataclass(frozen=True)
class Settings:
    enabled: bool = True
    margin_mm: float = 2.0
    rounds: int = 12
    sweeps: int = 15
    spread: float = 0.2


@dataclass(frozen=True)
class Cylinder:
    """A limb along y, and perhaps a wall at some z that belongs to another."""

    radius: float = 0.1
    wall_z: float = np.inf

    def contacts(self, points: np.ndarray) -> Contacts:
        flat = points * (1.0, 0.0, 1.0)
        distance = np.linalg.norm(flat, axis=1)
        normals = flat / distance[:, None]
        feet = points + (self.radius - distance)[:, None] * normals
        towards = np.maximum(normals[:, 2], 1e-12)
        room = np.where(normals[:, 2] > 1e-6, (self.wall_z - feet[:, 2]) / towards, np.inf)
        inside_wall = feet[:, 2] > self.wall_z
        return Contacts(
            distance - self.radius, normals, feet, normals, np.where(inside_wall, np.inf, room), inside_wall
        )

    def heights(self, points: np.ndarray, vertices: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        return self.contacts(points).heights


MESH = tube(32, 20, 0.115)
REST = MESH.vertices.astype(np.float64)
EDGES = unique_edges(MESH.faces)
LENGTHS = edge_lengths(REST, EDGES)
FRONT = REST[np.argmax(REST[:, 2] - np.abs(REST[:, 1] - REST[:, 1].mean()))]


def removal(config: Settings = Settings(), longest: float = 1.15) -> IntersectionRemoval:
    return IntersectionRemoval(MESH.faces, len(REST), LENGTHS, longest, config)


def pressed(depth: float) -> np.ndarray:
    """The tube with its side pressed into the limb."""
    vertices = REST.copy()
    vertices[:, 2] -= (depth + 0.015) * np.exp(-((vertices - FRONT) ** 2).sum(axis=1) / 0.05**2)
    return vertices


def stretch(vertices: np.ndarray) -> np.ndarray:
    return edge_stretch(vertices, EDGES, LENGTHS)


def test_cloth_that_is_outside_and_not_too_long_stays() -> None:
    for factor in (1.0, 1.1):
        vertices = REST * (factor, 1.0, factor)
        result = removal()(vertices, Cylinder())
        np.testing.assert_array_equal(result.vertices, vertices)
        assert result.before == result.after == Penetration(0.0, 0.0, 0.0)
        assert result.rest_moved_mm == 0.0
        assert not result.flipped.any()


@pytest.mark.parametrize("depth", [0.005, 0.02, 0.05])
def test_what_is_inside_comes_out_and_edges_are_kept(depth: float) -> None:
    before = pressed(depth)
    result = removal()(before, Cylinder())
    assert result.before.depth_max_mm == pytest.approx(1e3 * depth, rel=0.1)
    assert result.after.inside_percent == 0.0
    assert stretch_p99(stretch(result.vertices)) < 1.2
    assert stretch(result.vertices).max() < 1.3
    far = np.linalg.norm(REST - FRONT, axis=1) > 0.15
    assert result.moved_m[far].max() < 0.25 * result.moved_m.max()
    np.testing.assert_array_equal(result.was_inside, np.linalg.norm(before[:, [0, 2]], axis=1) < 0.1 - 1e-4)


@pytest.mark.parametrize("factor", [1.3, 2.0, 5.0])
def test_a_spike_is_drawn_in(factor: float) -> None:
    spiked = REST.copy()
    spiked[330] += factor * LENGTHS.max() * np.array([0.6, 0.0, 0.8]) * np.sign(REST[330] @ [0.6, 0.0, 0.8])
    result = removal()(spiked, Cylinder())
    assert stretch(spiked).max() > 1.2
    assert stretch(result.vertices).max() < 1.2
    far = np.linalg.norm(REST - REST[330], axis=1) > 0.15
    assert result.moved_m[far].max() < 0.01


def test_another_limb_does_not_push_cloth_through_itself() -> None:
    """A wall 10 mm over the limb, cloth 15 mm over it: it goes back to between the two, not through the wall."""
    result = removal()(REST, Cylinder(wall_z=0.11))
    assert result.before.inside_percent > 5
    assert result.after.inside_percent == 0.0
    assert result.vertices[:, 2].max() < 0.11
    assert stretch_p99(stretch(result.vertices)) < 1.2


def test_between_limbs_that_nearly_touch_cloth_is_in_the_middle() -> None:
    result = removal()(REST, Cylinder(wall_z=0.102))
    front = np.argmax(result.vertices[:, 2])
    assert result.vertices[front, 2] == pytest.approx(0.101, abs=3e-4)
    assert result.after.inside_percent == 0.0


def test_where_limbs_overlap_the_other_is_let_through_and_told() -> None:
    """The wall stands in the limb: nothing between the two is outside of both, and what is in the wall is not moved."""
    result = removal()(REST, Cylinder(wall_z=0.09))
    behind = REST[:, 2] / 0.115 * 0.1 > 0.09
    np.testing.assert_allclose(result.after.overlap_percent, 100 * behind.mean())
    assert result.after.inside_percent == 0.0
    assert result.vertices[behind, 2].min() > 0.09
    deep = Cylinder(wall_z=0.09).contacts(0.8 * REST)
    assert (deep.depths > 0).all(), "its own limb is never let through"


def test_without_removal_edges_are_kept_and_depth_is_only_told() -> None:
    before = pressed(0.03)
    off = removal(Settings(enabled=False))(before, Cylinder())
    assert off.after.inside_percent > 0
    loose = removal(Settings(enabled=False), longest=np.inf)(before, Cylinder())
    np.testing.assert_array_equal(loose.vertices, before)
    assert loose.before == loose.after


def test_it_turns_and_moves_with_the_cloth() -> None:
    turn, shift = Rotation.from_rotvec([0.0, 0.7, 0.0]).as_matrix(), np.array([0.0, 1.0, 0.0])
    before = pressed(0.03)
    here, there = (removal()(each, Cylinder()).vertices for each in (before, before @ turn.T + shift))
    np.testing.assert_allclose(there, here @ turn.T + shift, atol=1e-9)


def test_a_limb_that_pokes_through_a_face_is_seen() -> None:
    """Ten long faces around the limb: corners outside, middles inside."""
    angles = np.linspace(0, 2 * np.pi, 10, endpoint=False)
    ring = 0.1015 * np.stack([np.cos(angles), np.zeros(10), np.sin(angles)], axis=1)
    vertices = np.concatenate([ring, ring + np.array([0, 0.05, 0])])
    here, after = np.arange(10), np.roll(np.arange(10), -1)
    faces = np.concatenate([np.stack([after, here, here + 10], 1), np.stack([after, here + 10, after + 10], 1)])
    faces = faces.astype(np.int32)
    assert Cylinder().contacts(vertices).heights.min() > 0
    assert Cylinder().contacts(vertices[faces].mean(axis=1)).heights.max() < 0
    lengths = edge_lengths(vertices, unique_edges(faces))
    result = IntersectionRemoval(faces, 20, lengths, 1.15, Settings())(vertices, Cylinder())
    assert Cylinder().contacts(result.vertices[faces].mean(axis=1)).heights.min() > 0


def test_faces_turned_against_the_limb_are_found() -> None:
    inside_out = REST * (1, 1, -1)  # a mirror turns every face
    assert removal()(inside_out, Cylinder()).flipped.all()
    one = REST.copy()
    corner = MESH.faces[400]
    one[corner[0]] = one[corner[1:]].mean(axis=0) - 1.2 * (one[corner[0]] - one[corner[1:]].mean(axis=0))
    flipped = removal(Settings(rounds=0))(one, Cylinder()).flipped
    assert flipped[400]
    assert flipped.sum() < 8


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("size", [1e-4, 3e-3])
def test_projections_are_those_of_every_edge_and_vertex_in_turn(seed: int, size: float) -> None:
    """Against loops that look at all of them in every sweep, in their order; to the bit, over two calls."""
    rng = np.random.default_rng(seed)
    start = REST + size * rng.standard_normal(REST.shape)
    adjacency = vertex_adjacency(MESH.faces, len(REST))
    offsets, around = adjacency.indptr.astype(np.int64), adjacency.indices.astype(np.int32)
    longest, shortest = 1.01 * LENGTHS, 0.98 * LENGTHS
    due, travelled = np.full(len(EDGES), -1.0), np.zeros(len(REST))
    points, wanted = start.copy(), start.copy()
    for spread in (0.2, 0.0):
        found = Cylinder(0.113, wall_z=0.117).contacts(points)
        low, high = np.full(len(REST), 0.002), np.where(found.room < 0.01, found.room, np.inf)
        planes = found.feet, found.normals, found.outwards, low, high
        project(
            points, start, EDGES, longest, shortest, due, travelled, offsets, around, sweep_order(offsets, around),
            *planes, spread, 4,
        )  # fmt: skip
        in_turn(wanted, start, longest, shortest, adjacency, planes, spread)
        np.testing.assert_array_equal(points, wanted)
        assert np.abs(points - start).max() > 5e-5
    assert (due > 0).any(), "some edges were not looked at again"


def in_turn(points, start, longest, shortest, adjacency, planes, spread) -> None:
    """Four sweeps, written plainly."""
    feet, normals, outwards, low, high = planes

    def along(one: np.ndarray, other: np.ndarray) -> float:
        return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]

    for _ in range(4):
        for e, (i, j) in enumerate(EDGES):
            apart = points[i] - points[j]
            length = np.sqrt(along(apart, apart))
            share = 0.5 * (np.clip(length, shortest[e], longest[e]) - length) / max(length, 1e-12)
            points[i] += share * apart
            points[j] -= share * apart
        for v in range(len(points)):
            neighbours = adjacency.indices[adjacency.indptr[v] : adjacency.indptr[v + 1]]
            total = np.zeros(3)
            for n in neighbours:
                total += points[n] - start[n]
            points[v] += spread * (total / len(neighbours) - points[v] + start[v])
            height, away = along(normals[v], points[v] - feet[v]), along(outwards[v], points[v] - feet[v])
            if height < low[v]:
                points[v] += (low[v] - height) * normals[v]
            elif away > high[v]:
                points[v] += (high[v] - away) * outwards[v]
