"""Regions of a garment: every vertex in one, named for limbs and borders, alike on both sides."""

from dataclasses import replace

import numpy as np
import pytest

from capture4d.geometry.mesh import boundary_loops
from capture4d.types import Garment, Mesh
from registration.regions import find_regions
from tests.shapes import tube_faces

JOINTS = ("spine", "upperarm.L", "upperarm.R")


def lying_tube(around: int = 24, along: int = 81) -> Mesh:
    """An open tube along X, 0.1 m in radius and 1.2 m long: two sleeves and a trunk between them."""
    angle = 2 * np.pi * np.arange(around) / around
    ring = 0.1 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    places = np.linspace(-0.6, 0.6, along)
    vertices = np.concatenate([np.column_stack([np.full(around, x), ring]) for x in places])
    faces = tube_faces(around, along)
    mesh = Mesh(vertices.astype(np.float32), faces)
    first = vertices[faces[0]]
    outward = np.cross(first[1] - first[0], first[2] - first[0]) @ (first.mean(axis=0) * [0, 1, 1])
    return mesh if outward > 0 else Mesh(mesh.vertices, faces[:, ::-1].copy())


@pytest.fixture
def shirt() -> Garment:
    mesh = lying_tube()
    x = mesh.vertices[:, 0]
    weights = np.stack([np.abs(x) < 0.3, x >= 0.3, x <= -0.3], axis=1).astype(np.float32)
    right, left = sorted(boundary_loops(mesh.faces), key=lambda loop: mesh.vertices[loop, 0].mean())
    return Garment(mesh, {"cuff_left": left, "cuff_right": right}, skin_weights=weights)


def test_every_vertex_is_in_one_region(shirt):
    regions = find_regions(shirt, JOINTS)
    np.testing.assert_array_equal(
        np.sort(np.concatenate(list(regions.values()))), np.arange(len(shirt.template.vertices))
    )
    sides = {f"{side} {part}" for side in ("left", "right") for part in ("sleeve", "armpit", "shoulder")}
    assert set(regions) == sides | {"cuff left", "cuff right", "front", "back"}


def test_regions_lie_where_they_are_called(shirt):
    regions, places = find_regions(shirt, JOINTS), shirt.template.vertices
    assert (places[regions["left sleeve"], 0] > 0.3).all()
    assert (places[regions["right sleeve"], 0] < -0.3).all()
    assert (places[regions["cuff left"], 0] > 0.56).all()
    for side, sign in (("left", 1), ("right", -1)):
        for part, up in (("shoulder", 1), ("armpit", -1)):
            members = places[regions[f"{side} {part}"]]
            assert (np.abs(sign * members[:, 0] - 0.3) < 0.1).all()
            assert (up * members[:, 1] > -1e-3).all()
    assert (places[regions["front"], 2] > -0.02).all()
    assert (places[regions["back"], 2] < 0.02).all()


def test_both_sides_are_alike(shirt):
    regions = find_regions(shirt, JOINTS)
    for part in ("sleeve", "shoulder", "armpit"):
        assert abs(len(regions[f"left {part}"]) - len(regions[f"right {part}"])) <= 24


def test_smpl_s_names_are_understood(shirt):
    assert set(find_regions(shirt, ("spine1", "left_elbow", "right_elbow"))) == set(find_regions(shirt, JOINTS))


def test_cloth_that_no_joints_carry_has_borders_and_the_rest(shirt):
    regions = find_regions(replace(shirt, skin_weights=None), ())
    assert set(regions) == {"cuff left", "cuff right", "cloth"}
