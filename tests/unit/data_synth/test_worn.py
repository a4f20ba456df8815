"""Takes of other garments than a T-shirt: cut, put on, held, bound; and takes of T-shirts stay what they were."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from benchmarks.cached_takes import cached_take
from capture4d.body.skinning import ShapedBody, unskin, with_pose
from capture4d.errors import InputError
from capture4d.geometry.ray_casting import TriangleScene
from data_synth.cloth.patterns import mesh_pattern
from data_synth.cloth.tshirt import tshirt_pattern
from data_synth.config import (
    PRESETS,
    TRAINING_SETS,
    MotionConfig,
    RelaxationConfig,
    SynthConfig,
)
from data_synth.stage import SCHEMA
from data_synth.take import in_view, plan_take, simulate_take
from data_synth.worn import draft, dressing_pose, put_on, template_weights

BORDERS = {
    "shirt": {"neck", "hem", "cuff_left", "cuff_right"},
    "trousers": {"waist", "leg_left", "leg_right"},
    "skirt": {"waist", "hem"},
}


def test_without_a_word_it_is_the_t_shirt_of_the_style(person: ShapedBody) -> None:
    config = SynthConfig()
    for ours, theirs in zip(draft(config, person).panels, tshirt_pattern(person, config.style).panels, strict=True):
        assert ours.name == theirs.name
        for mine, other in zip(ours.edges, theirs.edges, strict=True):
            np.testing.assert_array_equal(mine.curve, other.curve)
    assert dressing_pose(config, person) is None


@pytest.mark.parametrize("name", [f"{garment}-{size}" for garment in BORDERS for size in ("demo", "200k")])
def test_presets_bring_their_garments(person: ShapedBody, name: str) -> None:
    config = PRESETS[name]
    assert config.name == name
    assert config.garment == name.split("-")[0]
    assert set(draft(config, person).borders) == BORDERS[config.garment]


def test_a_cut_that_the_garment_does_not_have_is_refused(person: ShapedBody) -> None:
    with pytest.raises(InputError, match=r"of a skirt .*length_m.*found 'sleeve_length=0.4'"):
        draft(SynthConfig(garment="skirt", cut=("sleeve_length=0.4",)), person)


@pytest.mark.parametrize("garment", ["trousers", "skirt"])
def test_bottoms_are_hung_outside_of_the_body_and_held_at_the_waist(person: ShapedBody, garment) -> None:
    config = SynthConfig(garment=garment)
    pattern = draft(config, person)
    mesh = mesh_pattern(pattern, 500, np.random.default_rng(0))
    rotations = dressing_pose(config, person)
    assert rotations is not None
    body = with_pose(person, rotations, np.array([0.3, 0.0, -0.2]))
    worn = put_on(config, person, mesh, pattern, body)
    found = TriangleScene((body.vertices(), person.body.template.faces)).nearest(worn.vertices)
    heights = np.einsum("vc,vc->v", worn.vertices - found.points, found.normals)
    assert np.percentile(heights, 1) > -0.002  # the mannequin's tubes are open where they meet
    root = person.joints[person.body.joint_names.index("root")]
    assert worn.held_from == pytest.approx(root[1] + 0.11, abs=0.02)
    assert worn.vertices[:, 0].mean() == pytest.approx(0.3, abs=0.01)


def test_a_skirts_template_follows_both_legs_or_the_hips_alone(person: ShapedBody) -> None:
    config, names = SynthConfig(garment="skirt"), person.body.joint_names
    body = with_pose(person, np.repeat(np.eye(3)[None], len(names), axis=0), np.zeros(3))
    between = np.array([[0.0, 0.65, 0.12], [0.18, 0.65, 0.0]])
    weights = template_weights(config, between, body)
    assert weights is not None
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-6)
    left, right = (names.index(f"upperleg01.{side}") for side in "LR")
    assert weights[0, left] == pytest.approx(weights[0, right], abs=0.02)
    assert weights[1, left] > weights[1, right] > 0
    alone = template_weights(replace(config, skirt_weights="root"), between, body)
    assert alone is not None
    np.testing.assert_array_equal(np.flatnonzero(alone.sum(axis=0)), [0])
    assert template_weights(SynthConfig(garment="trousers"), between, body) is None


def test_takes_made_before_there_were_other_garments_keep_their_place(tmp_path, monkeypatch) -> None:
    """Their key is what it was when nothing of garments was in it."""
    monkeypatch.setattr("benchmarks.cached_takes.user_cache_folder", lambda: tmp_path)
    monkeypatch.setattr("benchmarks.cached_takes.run", lambda *_, **__: None)
    for name in ("demo", "tshirt-200k", "tiny"):
        known = asdict(PRESETS[name])
        for later in ("print", "print_mm", "garment", "cut", "skirt_weights"):
            assert known.pop(later) is None
        key = hashlib.sha256(json.dumps([SCHEMA, known], sort_keys=True).encode()).hexdigest()[:12]
        assert cached_take(PRESETS[name]).name == f"{name}-{key}"
    assert all(take.garment is None for each in TRAINING_SETS.values() for take in each.takes.values())


@pytest.mark.slow
def test_a_waistband_keeps_its_seat_and_the_whole_person_is_in_view() -> None:
    """The skirt of the small preset, coarser still, on a person who squats."""
    demo = PRESETS["skirt-demo"]
    config = replace(
        demo,
        frames=2,
        capture_every=20,
        motion=MotionConfig("squat", skip_frames=24),
        simulation=replace(
            demo.simulation, vertices=300, substeps=8, calm_frames=10, approach_frames=14, rest_frames=1
        ),
        relaxation=RelaxationConfig(vertices=1000, sweeps=4),
    )
    take = plan_take(config)
    waist, seats = take.coarse.loops["waist"], {}
    for index, coarse, fine in simulate_take(take):
        body = take.bodies[index + take.lead]
        if index + take.lead == config.simulation.calm_frames - 1:
            weights = _trunk_weights(coarse[waist], body)
        if index + take.lead >= config.simulation.calm_frames - 1:
            seats[index] = unskin(coarse[waist], weights, body.transforms)[0]
        if fine is not None:
            skin = body.vertices()
            assert np.ptp(in_view(config, fine, skin)[:, 1]) > 0.9 * np.ptp(skin[:, 1])
    first = seats.pop(min(seats))
    slips = {index: float(np.linalg.norm(seat - first, axis=1).mean()) for index, seat in seats.items()}
    assert slips[min(slips)] < 0.010
    assert max(slips.values()) < 0.025


def _trunk_weights(points: np.ndarray, body) -> np.ndarray:
    skin_weights = body.shaped.body.skin_weights
    near = np.linalg.norm(points[:, None] - body.vertices()[None], axis=2).argmin(axis=1)
    return skin_weights[near]


def test_folds_here_and_there_remember_by_time_and_not_by_captured_frame() -> None:
    small = replace(PRESETS["tiny"], frames=2, relaxation=RelaxationConfig(vertices=2000))
    for every in (1, 4):
        levels = plan_take(replace(small, capture_every=every)).levels
        assert [level.config.warm_start for level in levels] == pytest.approx([0.945**every] * 2)
    even = plan_take(replace(small, folds=None, capture_every=4)).levels
    assert [level.config.warm_start for level in even] == [0.945]


def test_the_cloth_of_every_preset_folds_here_and_there() -> None:
    for take in (*PRESETS.values(), *(take for each in TRAINING_SETS.values() for take in each.takes.values())):
        assert take.folds is not None, take.name
