"""Cloth that cuts itself comes apart; what is not near a cut stays where it is."""

from __future__ import annotations

import numpy as np
import pytest

from capture4d.geometry.mesh import unique_edges
from capture4d.geometry.triangles import count_intersecting_faces
from data_synth.cloth.untangling import Room, untangle

SPACING_M = 0.01


def square(side: int, height: float, shift: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A flat square of `side` by `side` vertices: vertices, (V, 3), and faces."""
    number = np.arange(side * side).reshape(side, side)
    a, b, c, d = number[:-1, :-1].ravel(), number[1:, :-1].ravel(), number[1:, 1:].ravel(), number[:-1, 1:].ravel()
    plane = np.stack(np.divmod(number.ravel(), side), axis=1) * SPACING_M + shift
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return np.column_stack([plane, np.full(len(plane), height)]), faces


def two_layers(bump_m: float) -> tuple[np.ndarray, np.ndarray]:
    """A layer, and another 8 mm over it that a bump of the lower one, 40 mm wide, may pass through."""
    lower, faces = square(24, 0.0)
    upper, _ = square(24, 0.008, shift=0.0033)
    lower[:, 2] += bump_m * np.exp(-((lower[:, :2] - 0.115) ** 2).sum(axis=1) / 0.04**2)
    return np.concatenate([lower, upper]).astype(np.float32), np.concatenate([faces, faces + len(lower)]).astype(
        np.int32
    )


def settle(points: np.ndarray, faces: np.ndarray, steps: int, *, rests: bool = False) -> np.ndarray:
    """Untangle; the layers may rest on a body just beneath them, which else is a metre below."""
    edges = unique_edges(faces).astype(np.int32)
    lengths = np.linalg.norm(points[edges[:, 1]] - points[edges[:, 0]], axis=1)
    beneath = points if rests else points - np.array([0, 0, 1], np.float32)
    room = Room(points, 0.1, beneath, np.tile(np.array([0, 0, 1], np.float32), (len(points), 1)), 0.0)
    return untangle(points, faces, edges, lengths, room, steps=steps)


@pytest.mark.parametrize("bump_m", [0.010, 0.012])
def test_layers_that_have_just_passed_through_each_other_come_apart(bump_m: float) -> None:
    points, faces = two_layers(bump_m)
    assert count_intersecting_faces(points.astype(float), faces) > 10
    parted = settle(points, faces, 30)
    assert count_intersecting_faces(parted.astype(float), faces) == 0
    moved = np.linalg.norm(parted - points, axis=1)
    assert 0 < moved.max() < bump_m
    far = np.linalg.norm(points[:, :2] - 0.115, axis=1) > 0.11
    assert moved[far].max() == 0


def test_layers_apart_stay_as_they_are() -> None:
    points, faces = two_layers(0.006)
    assert settle(points, faces, 30) is points


def test_no_steps_part_nothing() -> None:
    points, faces = two_layers(0.012)
    assert settle(points, faces, 0) is points


def test_what_gives_way_stays_out_of_the_body() -> None:
    points, faces = two_layers(0.012)
    sunk = [float((points - settle(points, faces, 30, rests=rests))[:, 2].max()) for rests in (True, False)]
    assert sunk[0] < 3e-4, "but for the last sweep over the lengths"
    assert sunk[1] > 1e-3, "without the body the lower layer goes below its place"
