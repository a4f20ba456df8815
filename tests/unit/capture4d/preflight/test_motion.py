"""Motion capture of another person is told from that of the same person on another floor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from capture4d.body.anny import load_anny
from capture4d.body.posed_surface import BodyState, TrackedBody, pose_surface, tracked_body
from capture4d.preflight.mannequin import UNIT_NORMALS, sample_surface
from capture4d.preflight.motion import Motion, fit_person, floor_by_poses
from capture4d.preflight.survey import survey_take
from capture4d.types import Mesh

PERSON = np.array([0.5, -0.5, 0.3, 0, 0, 0, 0, 0, 0, 0])


@pytest.fixture(scope="module")
def model() -> TrackedBody:
    return tracked_body(load_anny())


def states(model: TrackedBody, shape: np.ndarray) -> list[BodyState]:
    """Two frames with the arms in different places."""
    rest = model.rest_state()
    found = []
    for angle in (0.3, -0.5):
        rotations = rest.rotations.copy()
        turn = [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
        rotations[model.body.joint_names.index("upperarm01.L")] = turn
        found.append(BodyState(rotations, np.array([0.1, 0.0, -0.2]), shape))
    return found


def upper_bodies(model: TrackedBody, lift_m: float) -> list[Mesh]:
    """Scans of PERSON from the hips upwards, lifted."""
    meshes = []
    for state in states(model, PERSON):
        vertices = pose_surface(model, state).vertices
        faces = model.body.template.faces
        above = (vertices[faces][:, :, 1] > 0.9).all(axis=1)
        meshes.append(Mesh((vertices + np.array([0, lift_m, 0])).astype(np.float32), faces[above]))
    return meshes


@pytest.mark.parametrize("lift_m", [0.0, 0.3, -0.12])
@pytest.mark.parametrize("other", [(0, 0, 0), (-1.2, 0, 0), (1.0, -1.0, 0.5)])
def test_shape_and_shift_are_found(model: TrackedBody, lift_m: float, other: tuple[float, ...]):
    given = PERSON + np.pad(np.array(other, np.float64), (0, 7))
    scans = upper_bodies(model, lift_m)
    motion = Motion(model, states(model, given), scans, True)
    samples = [sample_surface(mesh, count=400) / UNIT_NORMALS for mesh in scans]
    rise = floor_by_poses([sample[:, :3] for sample in samples], motion.surfaces()) - motion.floor()
    found = fit_person(motion, samples, rise_m=rise)
    np.testing.assert_allclose(found.shift, (0, lift_m, 0), atol=0.01)
    assert found.difference_m < 0.001 if not any(other) else found.difference_m > 0.015


def test_a_survey_lifts_for_the_same_person_only(model: TrackedBody):
    scans = upper_bodies(model, 0.3)
    same = survey_take(scans, 1.0, Motion(model, states(model, PERSON), scans, True))
    assert same.person_ratio is not None
    assert same.person_ratio < 0.2
    assert same.placement.lift_m == pytest.approx(-0.3, abs=0.01)
    shape = PERSON + np.pad([-1.5, 1.0], (0, 8))
    other = survey_take(scans, 1.0, Motion(model, states(model, shape), scans, True))
    assert other.person_ratio is not None
    assert other.person_ratio > 1
    assert not other.floor_exact
    assert other.placement.lift_m == 0


def test_motion_capture_moves_with_the_scans_whose_floor_it_shares(model: TrackedBody):
    for scans_m, poses_m, expected in ((0.4, 0.4, (-0.4, -0.4)), (0.3, 0.0, (-0.3, 0.0)), (0.0, 0.3, (0.0, 0.0))):
        scans = upper_bodies(model, scans_m)
        moved = [
            replace(state, translation=state.translation + np.array([0, poses_m, 0])) for state in states(model, PERSON)
        ]
        survey = survey_take(scans, 1.0, Motion(model, moved, scans, True))
        found = (survey.placement.lift_m, survey.poses_lift_m)
        np.testing.assert_allclose(found, expected, atol=0.01)


def test_samples_keep_their_normals(model: TrackedBody):
    sample = sample_surface(upper_bodies(model, 0.0)[0], count=50) / UNIT_NORMALS
    np.testing.assert_allclose(np.linalg.norm(sample[:, 3:], axis=1), 1, atol=1e-6)
