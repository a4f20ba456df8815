"""Rays against pieces of a limb meet what they meet against all of it."""

from itertools import pairwise

import numpy as np
import pytest
import trimesh

from capture4d.body.limb_rays import LEAVING_M, LimbPieces, PosedPieces
from capture4d.geometry.ray_casting import TriangleScene

BALL = trimesh.creation.icosphere(4)
VERTICES, FACES = np.array(BALL.vertices) * (0.1, 0.5, 0.1), np.array(BALL.faces, np.int32)


def test_every_face_is_in_one_piece_and_pieces_lie_together() -> None:
    pieces = LimbPieces.of(VERTICES, FACES)
    assert {tuple(face) for face in pieces.faces} == {tuple(face) for face in FACES}
    assert len(pieces.faces) == len(FACES)
    sizes = np.diff(pieces.offsets)
    assert 100 <= sizes.min() <= sizes.max() <= 200
    places = VERTICES[pieces.faces].mean(axis=1)
    extents = [np.ptp(places[first:end], axis=0).max() for first, end in pairwise(pieces.offsets)]
    assert max(extents) < 0.25, "of a limb that is a metre long"


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_rays_meet_what_they_meet_in_the_whole_limb(seed: int) -> None:
    """Two searches of one pose: the second wants other pieces than the first."""
    rng = np.random.default_rng(seed)
    limb, whole = PosedPieces(LimbPieces.of(VERTICES, FACES), VERTICES), TriangleScene((VERTICES, FACES))
    for reach in (0.03, 0.3):
        feet = rng.uniform(-1, 1, (500, 3)) * (0.15, 0.55, 0.15)
        outwards = rng.standard_normal((500, 3))
        outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
        points, strangers = feet + reach * outwards, np.flatnonzero(rng.random(500) < 0.7)
        chosen, hits = limb.cast(feet, points, outwards, strangers)
        wanted = whole.cast(np.hstack([feet + LEAVING_M * outwards, outwards]))
        assert hits is not None
        assert 20 < np.isfinite(hits.distance).sum() <= len(chosen) < len(strangers)
        np.testing.assert_array_equal(hits.distance, wanted.distance[chosen])
        np.testing.assert_array_equal(hits.normals, wanted.normals[chosen])
        ends = np.stack([feet, points])
        beside = (ends.max(axis=0) > VERTICES.min(axis=0)).all(axis=1) & (ends.min(axis=0) < VERTICES.max(axis=0)).all(
            axis=1
        )
        left_out = np.setdiff1d(strangers[beside[strangers]], chosen)
        assert np.isinf(wanted.distance[left_out]).all()


def test_nothing_is_met_by_rays_that_lead_away() -> None:
    limb = PosedPieces(LimbPieces.of(VERTICES, FACES), VERTICES)
    feet, outwards = np.array([[0.12, 0.0, 0.0]]), np.array([[1.0, 0.0, 0.0]])
    chosen, hits = limb.cast(feet, feet + 0.01 * outwards, outwards, np.array([0]))
    assert len(chosen) == 0
    assert hits is None
