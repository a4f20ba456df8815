"""What of a garment is inside the parts of the body that it meets."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from capture4d.body.skinning import ShapedBody, with_pose
from capture4d.geometry.mesh import vertex_normals
from capture4d.types import Mesh
from data_synth.drapes.quality import inside_parts


@pytest.mark.parametrize(("meets", "depth_m", "counted"), [(1, 3e-3, 1), (1, -3e-3, 0), (1, 5e-4, 0), (0, 3e-3, 0)])
def test_a_vertex_counts_where_it_is_inside_a_part_that_it_meets(
    person: ShapedBody, meets: int, depth_m: float, counted: int
):
    body = with_pose(person, np.repeat(np.eye(3)[None], len(person.joints), axis=0), np.zeros(3))
    surface = body.vertices()
    names = person.body.joint_names
    arm = person.body.skin_weights[:, [name.startswith(("upperarm", "lowerarm")) for name in names]].sum(axis=1) > 0.5
    arm &= surface[:, 0] > 0
    reach = np.quantile(surface[arm, 0], (0.65, 0.85))  # clear of elbow and shoulder, where tubes overlap
    under = np.flatnonzero(arm & (surface[:, 0] > reach[0]) & (surface[:, 0] < reach[1]))
    points = (surface - depth_m * vertex_normals(surface, person.body.template.faces))[under]
    contacts = np.arange(len(under)), np.full(len(under), meets)
    inside = inside_parts(body, np.stack([~arm, arm]), contacts, points)
    assert len(under) > 5
    assert inside.mean() == counted


@pytest.mark.parametrize(("gap_m", "counted"), [(0.003, False), (0.02, True)])
def test_cloth_counts_where_there_is_room_for_it_between_limbs(person: ShapedBody, gap_m: float, counted: bool):
    upper, lower = box((0.2, 0.1, 0.2), (0, 0.05 + gap_m / 2, 0)), box((0.2, 0.1, 0.2), (0, -0.05 - gap_m / 2, 0))
    vertices = np.concatenate([upper[0], lower[0]]).astype(np.float32)
    faces = np.concatenate([upper[1], lower[1] + len(upper[0])]).astype(np.int32)
    body = with_pose(on(person, vertices, faces), np.repeat(np.eye(3)[None], len(person.joints), axis=0), np.zeros(3))
    points = np.array([[0.003, gap_m / 2 + 0.002, 0.002]])  # in the upper box, above its lower side
    masks = np.ones((1, len(vertices)), bool)
    assert inside_parts(body, masks, (np.zeros(1, int), np.zeros(1, int)), points)[0] == counted


def box(size: tuple[float, float, float], centre: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """A cube's surface scaled and moved: vertices (8, 3), outward faces (12, 3)."""
    hull = ConvexHull(np.array(list(product((-0.5, 0.5), repeat=3))))
    faces = hull.simplices.copy()
    first, second = (hull.points[faces[:, k]] - hull.points[faces[:, 0]] for k in (1, 2))
    normals = np.cross(first, second)
    flipped = (normals * hull.equations[:, :3]).sum(axis=1) < 0
    faces[flipped] = faces[flipped][:, ::-1]
    return hull.points * size + centre, faces


def on(person: ShapedBody, vertices: np.ndarray, faces: np.ndarray) -> ShapedBody:
    """Another skin on the mannequin's root joint."""
    weights = np.zeros((len(vertices), len(person.joints)), np.float32)
    weights[:, 0] = 1
    body = replace(
        person.body,
        template=Mesh(vertices, faces),
        shape_directions=np.zeros((1, len(vertices), 3), np.float32),
        skin_weights=weights,
    )
    return replace(person, body=body, vertices=vertices.astype(np.float64))
