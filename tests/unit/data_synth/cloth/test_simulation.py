"""Coarse cloth on the mannequin: dressed, closed, outside the body, and the same bits every time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from capture4d.body.skinning import ShapedBody, unskin
from capture4d.geometry.mesh import unique_edges
from data_synth.cloth.fabrics import Fabric
from data_synth.cloth.patterns import mesh_pattern
from data_synth.cloth.simulation import approach_poses, dress, simulate
from data_synth.cloth.template import bind_template
from data_synth.cloth.tshirt import tshirt_pattern
from data_synth.cloth.wrinkle_relaxation import BodySurface
from data_synth.config import GarmentStyle, MotionConfig, SimulationConfig
from data_synth.motions import make_motion

SETTINGS = SimulationConfig(vertices=500, calm_frames=12, approach_frames=6, rest_frames=2)


@pytest.fixture(scope="module")
def simulated(person: ShapedBody):
    pattern = tshirt_pattern(person, GarmentStyle(ease=0.3))
    mesh = mesh_pattern(pattern, SETTINGS.vertices, np.random.default_rng(0))
    poses = make_motion(person, MotionConfig("twist"), 60.0, 4, np.random.default_rng(0))
    bodies = approach_poses(person, poses, SETTINGS)
    start = dress(person, mesh, pattern, bodies[0])
    return mesh, bodies, start, list(simulate(mesh, start, bodies, Fabric(), SETTINGS))


@pytest.mark.parametrize("ease", [0.12, 0.3])
@pytest.mark.parametrize("vertices", [500, 1500])
def test_no_edge_of_the_hung_panels_runs_through_the_body(person: ShapedBody, ease: float, vertices: int) -> None:
    pattern = tshirt_pattern(person, GarmentStyle(ease=ease))
    mesh = mesh_pattern(pattern, vertices, np.random.default_rng(0))
    poses = make_motion(person, MotionConfig("twist"), 60.0, 1, np.random.default_rng(0))
    body = approach_poses(person, poses, SETTINGS)[0]
    start, end = dress(person, mesh, pattern, body)[unique_edges(mesh.faces)].transpose(1, 0, 2)
    samples = np.concatenate([start + share * (end - start) for share in np.linspace(0, 1, 9)])
    planes = BodySurface.create(body.vertices(), person.body.template.faces).planes(samples)
    depth = -np.einsum("vc,vc->v", samples - planes.points, planes.normals)
    assert depth.max() < 0.015, "limbs are tubes of 45 mm radius: deeper, and the edge runs through them"


@pytest.mark.slow
def test_panels_close_to_their_own_size(simulated) -> None:
    mesh, _, start, frames = simulated
    rest = np.linalg.norm(mesh.uv[:, 1] - mesh.uv[:, 0], axis=1)

    def stretch(points: np.ndarray) -> np.ndarray:
        ends = points[mesh.faces]
        return np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / rest

    assert np.percentile(stretch(start), 99) > 1.3, "the cloth is hung around the body stretched"
    assert np.percentile(stretch(frames[-1]), 90) < 1.15


@pytest.mark.slow
def test_cloth_keeps_outside_the_limbs_it_covers(simulated, person: ShapedBody) -> None:
    _, bodies, _, frames = simulated
    names, parents = person.body.joint_names, person.body.parents
    transforms = bodies[-1].transforms
    joints = np.einsum("jab,jb->ja", transforms[:, :3, :3], person.joints) + transforms[:, :3, 3]
    for name in ("lowerarm01.L", "lowerarm01.R", "wrist.L", "wrist.R"):  # ends of tubes of 45 mm radius
        joint = names.index(name)
        start, bone = joints[parents[joint]], joints[joint] - joints[parents[joint]]
        share = (frames[-1] - start) @ bone / (bone @ bone)
        beside = (share > 0.05) & (share < 0.95)
        distance = np.linalg.norm(frames[-1] - start - share[:, None] * bone, axis=1)[beside]
        assert distance.min(initial=1.0) > 0.038, f"cloth inside {name}"


@pytest.mark.slow
def test_equal_input_gives_equal_bits(simulated) -> None:
    mesh, bodies, start, frames = simulated
    again = list(simulate(mesh, start, bodies[:6], Fabric(), SETTINGS))
    np.testing.assert_array_equal(np.array(again), np.array(frames[:6]))


@pytest.mark.slow
def test_the_hold_keeps_the_cloth_in_its_seat(simulated) -> None:
    mesh, bodies, start, _ = simulated
    still = bodies[: SETTINGS.calm_frames + 1] + [bodies[SETTINGS.calm_frames]] * 12

    def slid(hz: float) -> float:
        settings = replace(SETTINGS, hold_hz=hz, hold_floor=1.0)
        frames = list(simulate(mesh, start, still, Fabric(), settings))
        return float(np.linalg.norm(frames[-1] - frames[SETTINGS.calm_frames - 1], axis=1).mean())

    free, loose, firm = slid(0.0), slid(3.0), slid(12.0)
    assert firm < loose < free
    assert firm < 0.5 * free


@pytest.mark.slow
def test_template_is_bound_where_it_lies(simulated) -> None:
    mesh, bodies, _, frames = simulated
    garment = bind_template(
        mesh, frames[SETTINGS.calm_frames - 1], bodies[SETTINGS.calm_frames - 1], frames[-1], bodies[-1]
    )
    assert garment.skin_weights is not None
    rest, flagged = unskin(frames[-1], garment.skin_weights, bodies[-1].transforms)
    assert not flagged.any()
    np.testing.assert_allclose(rest, garment.template.vertices, atol=1e-5)
    dominant = np.array(bodies[0].shaped.body.joint_names)[np.argmax(garment.skin_weights, axis=1)]
    assert set(dominant[garment.loops["hem"]]) <= {"root", "spine04", "upperleg01.L", "upperleg01.R"}
    assert all(name.endswith(".L") for name in dominant[garment.loops["cuff_left"]])
