"""The page of a set of drapes: what it says of faces and of joints is what can be counted by hand."""

from __future__ import annotations

import re

import numpy as np
from scipy.spatial.transform import Rotation

from capture4d.app.report.drapes import DrapeSet, angle_charts, by_face
from capture4d.types import Garment, Mesh

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
FACES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def drape_set(kept: list[bool], *, scales: list[float], cuts: list[list[bool]], bends: list[float]) -> DrapeSet:
    rotations = Rotation.from_euler("x", np.array(bends)[:, None], degrees=True).as_matrix()[:, None]
    return DrapeSet(
        {"joint_names": ["elbow"], "moved_joints": ["elbow"]},
        Garment(Mesh(SQUARE, FACES, SQUARE[FACES][..., :2].copy())),
        rotations,
        np.array(scales)[:, None, None] * SQUARE,
        np.array(kept),
        {},
        ["" if each else "area" for each in kept],
        np.array(cuts),
    )


def test_areas_and_cuts_are_means_of_what_is_kept():
    drapes = drape_set(
        [True, True, False],
        scales=[1.0, 1.2, 9.0],
        cuts=[[True, False], [False, False], [True, True]],
        bends=[0, 10, 20],
    )
    distortion, cut = by_face(drapes)
    np.testing.assert_allclose(distortion, (1.0 + 1.44) / 2 - 1, atol=1e-6)
    np.testing.assert_allclose(cut, [0.5, 0.0])
    nothing, _ = by_face(drape_set([False], scales=[1.0], cuts=[[True, True]], bends=[0]))
    assert np.isnan(nothing).all()


def test_angles_are_drawn_of_all_and_of_what_is_kept():
    def curves(kept: list[bool]) -> list[str]:
        count = len(kept)
        drapes = drape_set(
            kept, scales=[1.0] * count, cuts=[[False] * 2] * count, bends=[10.0 * i for i in range(count)]
        )
        (chart,) = angle_charts(drapes)  # the elbow turns about one axis
        assert chart.title == "elbow, bend, degrees"
        return re.findall(r'class="curve" d="([^"]+)"', chart.svg)

    everything, kept = curves([True] * 8)
    assert everything == kept
    everything, kept = curves([True] * 4 + [False] * 4)
    assert everything != kept
