"""Garments with styles, learned from drapes that a formula made: unposed, learned, posed again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture4d.body.skinning import skin, with_pose, with_shape
from capture4d.captures.drapes.style_sets import StyleSet
from capture4d.errors import InputError
from retarget.mixture.baselines import BASELINES, blended_prototypes, nearest_drape, skinned
from retarget.mixture.config import MixtureConfig, NetworkConfig, SplitConfig, StylesConfig
from retarget.mixture.evaluation import measure, unposed_by
from retarget.mixture.learning import learn_styles
from retarget.mixture.lesson import PARTS, StyleLesson, style_lesson
from retarget.mixture.model_files import load_styled_garment, save_styled_garment
from retarget.mixture.predictors import Mixture
from retarget.mixture.styled_garment import StyledGarment
from tests.unit.retarget.mixture.conftest import canonical_displacement, motion, pose_displacement

NETWORK = NetworkConfig(hidden=32, epochs=80, dropout=0.0, learning_rate=5e-3)
ENSEMBLE = StylesConfig(network=NETWORK, members=1)
MIXTURE = StylesConfig(
    method="mixture", network=NETWORK, mixture=MixtureConfig(SplitConfig(half_m=0.3), NETWORK)
)  # fmt: skip


@pytest.fixture(scope="module")
def lesson(style_set: StyleSet) -> StyleLesson:
    return style_lesson(style_set)


@pytest.fixture(scope="module")
def learned(lesson: StyleLesson, tmp_path_factory: pytest.TempPathFactory) -> dict[str, StyledGarment]:
    folder = tmp_path_factory.mktemp("learned")
    configs = {"ensemble": ENSEMBLE, "mixture": MIXTURE, "mlp": replace(BASELINES["mlp"], network=NETWORK)}
    return {name: learn_styles(lesson, config, folder / name)[0] for name, config in configs.items()}


def test_unposed_drapes_are_what_was_posed(lesson: StyleLesson, style_set: StyleSet):
    """Whatever the style and the person, D is what the formula added before the pose."""
    for pair, source in zip(lesson.pairs, style_set.pairs, strict=True):
        style, shape = source.drapes.style["length"], float(source.drapes.shape[0])
        at_rest = canonical_displacement(lesson.garment, style, shape)
        np.testing.assert_allclose(pair.canonical - pair.under, at_rest, atol=1e-6)
        for rotations, unposed in zip(pair.rotations, pair.unposed, strict=True):
            angle = np.arctan2(rotations[1, 2, 1], rotations[1, 2, 2])
            wanted = at_rest + pose_displacement(lesson.garment, float(angle), style)
            np.testing.assert_allclose(unposed - pair.under, wanted, atol=2e-6)
        np.testing.assert_allclose(pair.posed(pair.unposed, lesson.skin_weights), source.drapes.vertices, atol=2e-6)


def test_pairs_and_poses_are_in_one_part_each(lesson: StyleLesson):
    drapes = {part: [(pair.name, int(pose)) for pair, rows in lesson.of_part(part) for pose in pair.poses[rows]]
              for part in PARTS}  # fmt: skip
    assert {part: len(found) for part, found in drapes.items()} == {
        "train-train": 4 * 14, "train-test": 4 * 3, "test-train": 2 * 4, "test-test": 2 * 3
    }  # fmt: skip
    every = [each for found in drapes.values() for each in found]
    assert len(every) == len(set(every))
    seen = {pose for part in ("train-train", "test-train") for _, pose in drapes[part]}
    assert not seen & {pose for part in ("train-test", "test-test") for _, pose in drapes[part]}


def test_pruned_drapes_are_in_no_part(style_set: StyleSet):
    first = style_set.pairs[0]
    kept = first.drapes.kept.copy()
    kept[[0, 5]] = False
    pruned = replace(first, drapes=replace(first.drapes, kept=kept))
    lesson = style_lesson(replace(style_set, pairs=[pruned, *style_set.pairs[1:]]))
    assert lesson.pairs[0].poses.tolist() == [each for each in range(1, 18) if each not in (1, 6)]
    assert len(lesson.pairs[0].unposed) == 15


def test_the_a_pose_of_a_style_that_was_not_tried_is_foretold(learned: dict[str, StyledGarment], lesson: StyleLesson):
    """Displacements in the A-pose are linear here, which kernels over a plane have to find."""
    worn = learned["ensemble"].worn([0.35], {"length": 0.72})
    wanted = canonical_displacement(lesson.garment, 0.72, 0.35)
    base = worn.in_a_pose - wanted
    np.testing.assert_allclose(base, learned["ensemble"].worn([0.35], {"length": 0.44}).in_a_pose
                               - canonical_displacement(lesson.garment, 0.44, 0.35), atol=2e-4)  # fmt: skip


def test_what_is_learned_beats_what_learns_nothing(learned: dict[str, StyledGarment], lesson: StyleLesson):
    errors = {name: measure(lesson, unposed_by(garment)) for name, garment in learned.items()}
    ensemble = learned["ensemble"]
    errors |= {
        "skinned": measure(lesson, skinned(ensemble)),
        "nearest": measure(lesson, nearest_drape(lesson, ensemble)),
        "blended": measure(lesson, blended_prototypes(lesson, ensemble)),
    }
    for part in ("train-test", "test-train", "test-test"):
        found = {name: each[part].vertex_mm for name, each in errors.items()}
        assert found["ensemble"] < 0.5 * found["skinned"]
        assert found["ensemble"] < found["nearest"]
        assert found["mixture"] < 0.85 * found["skinned"]
    # what is linear in style and shape is a convex combination of the corners, where their drapes are known
    assert errors["blended"]["test-train"].vertex_mm < 0.01
    assert errors["skinned"]["test-test"].fine_share == pytest.approx(0, abs=1e-9)
    assert 0.7 < errors["ensemble"]["test-test"].fine_share < 1.2
    assert errors["ensemble"]["test-test"].drapes == 6


def test_a_prediction_that_is_the_truth_has_no_error(lesson: StyleLesson):
    errors = measure(lesson, lambda pair: pair.unposed)
    assert set(errors) == set(PARTS)
    for each in errors.values():
        assert (each.vertex_mm, each.unposed_mm) == (0, 0)
        assert each.normal_deg < 1e-4
        assert each.fine_share == pytest.approx(1)
    shifted = measure(lesson, lambda pair: pair.unposed + np.array([0, 0, 0.003], np.float32))
    assert shifted["test-test"].unposed_mm == pytest.approx(3, rel=1e-3)
    assert shifted["test-test"].fine_share == pytest.approx(1, rel=1e-3)


@pytest.mark.parametrize("name", ["ensemble", "mixture"])
def test_frames_as_they_come_are_those_of_a_batch(learned: dict[str, StyledGarment], name: str):
    garment, places = learned[name], np.array([[0, 0, 0], [0, 0.2, 0], [1, 0, 0]], np.float32)
    poses = motion([0.1, 0.9, 0.4], places)
    batch = garment.vertices(poses, [0.2], {"length": 0.5}, remove_intersections=False)
    worn = garment.worn([0.2], {"length": 0.5})
    stream = worn.frames(zip(poses.rotations, places, strict=True), remove_intersections=False)
    np.testing.assert_array_equal(batch, np.stack([*stream]))
    together = worn.unposed(poses.rotations)  # one call of the networks and kernels for all frames
    body = with_pose(with_shape(garment.body, np.array([0.2])), poses.rotations[1], places[1])
    assert garment.garment.skin_weights is not None
    np.testing.assert_allclose(batch[1], skin(together[1], garment.garment.skin_weights, body.transforms), atol=1e-6)


def test_cloth_is_taken_out_of_the_body(learned: dict[str, StyledGarment]):
    """A garment that is tighter than any that was draped."""
    garment = learned["ensemble"]
    tight = replace(garment, canonical=replace(garment.canonical, mean=-0.6 * garment.garment.template.vertices
                                               * np.array([1, 0, 1])))  # fmt: skip
    poses = motion([0.0, 0.2])
    inside, outside = (tight.vertices(poses, [0.0], remove_intersections=each) for each in (False, True))
    radius = np.linalg.norm(inside[0][:, [0, 2]], axis=1), np.linalg.norm(outside[0][:, [0, 2]], axis=1)
    assert radius[0].min() < 0.09
    assert radius[1].min() > 0.098 * np.cos(np.pi / 8)  # of the eight-sided body


def test_a_turned_person_wears_a_turned_garment(learned: dict[str, StyledGarment]):
    garment, poses = learned["ensemble"], motion([0.6])
    rotations = poses.rotations.copy()
    rotations[0, 0] = turn = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], np.float32)
    turned = replace(poses, rotations=rotations)
    before, after = (garment.vertices(each, [0.5], remove_intersections=False)[0] for each in (poses, turned))
    root = garment.body.joints[0]
    np.testing.assert_allclose(after - root, (before - root) @ turn.T, atol=1e-6)


@pytest.mark.parametrize("name", ["ensemble", "mixture"])
def test_a_garment_comes_back_from_its_files(learned: dict[str, StyledGarment], tmp_path: Path, name: str):
    save_styled_garment(tmp_path, learned[name])
    again = load_styled_garment(tmp_path)
    asked = motion([0.3, 1.2]), [0.9], {"length": 0.41}
    first, second = (each.vertices(*asked, remove_intersections=False) for each in (learned[name], again))
    np.testing.assert_array_equal(first, second)
    assert again.ranges == learned[name].ranges


def test_poses_of_another_skeleton_are_refused(learned: dict[str, StyledGarment]):
    other = replace(motion([0.1]), joint_names=("root", "hip", "toe"))
    with pytest.raises(InputError, match="pose: expected the 3 joints of the model, found 3"):
        learned["ensemble"].vertices(other)


@pytest.mark.parametrize(
    ("beta", "style", "said"),
    [
        ([0.0], {"length": 0.9}, "style length: expected 0.4 to 0.8, as it was learned, found 0.9"),
        ([2.0], {}, "beta 1: expected -1 to 1, as it was learned, found 2"),
        ([0.0, 1.0], {}, "beta 2: expected 0, for it was not varied, found 1"),
        ([0.0], {"sleeve": 1.0}, "style: expected length, found 'sleeve'"),
    ],
)
def test_what_was_not_learned_is_refused(
    learned: dict[str, StyledGarment], beta: list[float], style: dict[str, float], said: str
):
    with pytest.raises(InputError, match=said):
        learned["ensemble"].worn(beta, style)


def test_a_prototype_hears_itself_and_as_printed_weights_do_not_sum_to_one(
    learned: dict[str, StyledGarment], lesson: StyleLesson
):
    mixture = learned["mixture"].predictor
    assert isinstance(mixture, Mixture)
    narrow = replace(mixture, bandwidth=1e-4)
    for k, canonical in enumerate(mixture.prototypes):
        weights = narrow.weights(canonical)
        assert weights.argmax() == k
        assert weights.sum() == pytest.approx(1)
    between = mixture.prototypes[:2].mean(axis=0)
    assert replace(narrow, normalised=False).weights(between).sum() < 0.9


def test_neither_networks_nor_kernels_is_refused(lesson: StyleLesson, tmp_path: Path):
    with pytest.raises(InputError, match="expected networks, kernels or both, found neither"):
        learn_styles(lesson, StylesConfig(members=0, kernels=False), tmp_path)
