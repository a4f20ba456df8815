"""What of a garment is inside the parts of the body that it meets."""

from __future__ import annotations

import numpy as np
import pytest

from capture4d.body.skinning import ShapedBody, with_pose
from capture4d.geometry.mesh import vertex_normals
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
