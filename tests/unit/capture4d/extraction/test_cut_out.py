"""The borders of a garment whose colours are learned, named by their shape."""

from __future__ import annotations

import numpy as np
import pytest

from capture4d.captures.take_colours import KnownColours
from capture4d.colours.learning import Light
from capture4d.extraction import garment
from capture4d.extraction.border_loops import SHIRT
from capture4d.extraction.garment import cut_out
from capture4d.types import GarmentScan, Mesh, Scan
from tests.unit.capture4d.extraction.test_border_loops import shirt


def test_borders_of_one_learned_paint_are_separated_named_and_ordered(monkeypatch: pytest.MonkeyPatch) -> None:
    loops = shirt(-50)
    order = np.random.default_rng(0).permutation(sum(map(len, loops)))
    points = np.concatenate(loops)[order].astype(np.float32)
    mesh = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32))
    unnamed = GarmentScan(mesh, points, np.full(len(points), -1, np.int32), SHIRT, 1)
    monkeypatch.setattr(garment, "extract_garment", lambda *_, **__: unnamed)
    monkeypatch.setattr(Light, "removed", lambda _, mesh, colours: colours)
    paint = dict.fromkeys(SHIRT, (255, 210, 0))
    colours = KnownColours((47, 98, 201), paint, SHIRT, light=Light(np.zeros((1, 3)), np.zeros(3), 1.0))
    found = cut_out(Scan(mesh, np.zeros((3, 3), np.uint8), 1, 0.0), colours)
    assert np.bincount(found.boundary_loops).tolist() == [len(loop) for loop in loops]
    for index, loop in enumerate(loops):
        own = found.boundary_points[found.boundary_loops == index]
        assert np.linalg.norm(own - np.roll(own, 1, axis=0), axis=1).max() < 0.02, "in order around it"
        assert np.linalg.norm(own.mean(axis=0) - loop.mean(axis=0)) < 1e-4


def test_borders_of_given_paints_stay_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.concatenate(shirt(-50)).astype(np.float32)
    mesh = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32))
    named = GarmentScan(mesh, points, np.arange(len(points), dtype=np.int32) % 4, SHIRT, 1)
    monkeypatch.setattr(garment, "extract_garment", lambda *_, **__: named)
    paint = {name: (255, 210, index) for index, name in enumerate(SHIRT)}
    scan = Scan(mesh, np.zeros((3, 3), np.uint8), 1, 0.0)
    assert cut_out(scan, KnownColours((47, 98, 201), paint, SHIRT)) is named
