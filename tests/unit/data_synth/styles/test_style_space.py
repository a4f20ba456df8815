"""Components of styles, of garments that a formula makes; and of two rounds of draped neckties."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture4d.body.skinning import ShapedBody
from capture4d.captures.drapes.style_sets import read_style_set
from capture4d.errors import InputError
from data_synth.drapes import stage as drapes
from data_synth.drapes.config import STYLES, SolverConfig
from data_synth.styles import stage
from data_synth.styles.config import STYLE_SETS, StyleSetConfig
from data_synth.styles.pairs import grid, offered, require_possible
from data_synth.styles.style_space import LIMIT, TERMS, StyleSpace, find_space, subspace_cosines

RANGES = {"length": (0.2, 0.8), "size": (0.9, 1.1), "ease": (0.0, 0.4)}
WEIGHTS = {"length": 4.0, "size": -2.0, "ease": 0.5}
"""How much a number moves the garment: in this order they are components, for each in a direction of its own."""


def garments(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Patterns, and garments that are linear in them."""
    rng = np.random.default_rng(seed)
    low, high = np.array([*RANGES.values()]).T
    patterns = low + (high - low) * rng.random((count, 3))
    basis = np.linalg.qr(np.random.default_rng(99).standard_normal((60, 3)))[0].T
    places = (patterns - low) / (high - low)
    return patterns, (places * [*WEIGHTS.values()] @ basis).reshape(count, 20, 3)


@pytest.fixture(scope="module")
def space() -> StyleSpace:
    return find_space(RANGES, *garments(400, 0))


def test_components_are_named_after_what_goes_with_them_and_grow_with_it(space: StyleSpace):
    assert space.names == ("longer", "larger", "wider")
    assert (np.diff(space.explained) < 0).all()
    assert space.explained.sum() == pytest.approx(1.0)
    for row, number in enumerate(RANGES):
        assert space.cut(np.eye(3)[row])[number] > space.cut(np.zeros(3))[number]


def test_the_cut_of_a_style_has_that_style(space: StyleSpace):
    """What is linear goes there and back exactly."""
    patterns, vertices = garments(50, 1)
    for pattern, gamma in zip(patterns, space.scores(vertices), strict=True):
        np.testing.assert_allclose([*space.cut(gamma).values()], pattern, atol=1e-9)


def test_scores_are_in_standard_deviations():
    patterns, vertices = garments(200, 2)
    scores = find_space(RANGES, patterns, vertices).scores(vertices)
    np.testing.assert_allclose(scores.std(axis=0), 1.0)
    np.testing.assert_allclose(scores.mean(axis=0), 0.0, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_every_style_is_a_pattern_that_can_be_sewn(space: StyleSpace, seed: int):
    rng = np.random.default_rng(seed)
    for gamma in rng.uniform(-LIMIT, LIMIT, (40, 3)):
        for name, value in space.cut(gamma).items():
            assert RANGES[name][0] <= value <= RANGES[name][1]
    drawn = space.drawn(500, rng)
    assert np.abs(drawn).max() == LIMIT
    assert space.cut([0.7]) == space.cut([0.7, 0.0, 0.0])


def test_a_sign_does_not_depend_on_the_draw():
    """Nor does the order of the garments."""
    for seed in range(6):
        patterns, vertices = garments(60, seed)
        found = find_space(RANGES, patterns[::-1], vertices[::-1])
        assert found.slopes[0, 0] > 0
        assert found.slopes[1, 1] > 0


def test_subspaces_agree_as_far_as_they_do():
    basis = np.linalg.qr(np.random.default_rng(0).standard_normal((30, 6)))[0].T
    np.testing.assert_allclose(subspace_cosines(basis[:3], basis[[2, 0, 1]]), 1.0)
    angle = 0.3
    turned = np.stack([basis[0], np.cos(angle) * basis[1] + np.sin(angle) * basis[5]])
    np.testing.assert_allclose(subspace_cosines(basis[:2], turned), [1.0, np.cos(angle)])
    np.testing.assert_allclose(subspace_cosines(basis[:2], basis[2:4]), 0.0, atol=1e-12)


def test_every_number_of_a_pattern_has_a_term():
    assert {name for kind in STYLES.values() for name in kind.__dataclass_fields__} == set(TERMS)


def test_what_is_offered_is_even_between_the_limits():
    config = replace(STYLE_SETS["tshirt-style-space"], levels=5)
    require_possible(config)
    pairs = grid(offered(config, ("longer", "wider", "larger")))
    assert len(pairs) == 25 * 9
    assert pairs[0].style == (0.0, 0.0)
    assert {pair.style[0] for pair in pairs} == {-1.5, -0.75, 0.0, 0.75, 1.5}
    with pytest.raises(InputError, match="components: expected at most 2"):
        require_possible(replace(config, styles={"size": (0.9, 1.1), "ease": (0.1, 0.3)}, components=3))


TIES = StyleSetConfig(
    garment="necktie",
    styles={"length_m": (0.3, 0.55), "width_m": (0.06, 0.1)},
    components=1,
    drawn=8,
    levels=3,
    shapes=((0.0,), (1.0,)),
    prototypes=2,
    poses=2,
    unseen_poses=1,
    test_pairs=1,
    off_grid=1,
    seen_poses=1,
    vertices=110,
    solver=SolverConfig(frames=25),
)


def test_a_set_of_components_is_made_and_read(person: ShapedBody, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for module in (stage, drapes):
        monkeypatch.setattr(module, "load_anny", lambda: person.body)
    folder = tmp_path / "set"
    digest = stage.run(folder, TIES).digest
    found = read_style_set(folder)
    assert found.ranges.style == {"longer": (-LIMIT, LIMIT)}
    assert len(found.canonical.vertices) == 3 * 2 + 1
    lengths = {}
    for pair in found.pairs:
        assert -LIMIT <= pair.style["longer"] <= LIMIT
        lengths[pair.style["longer"]] = pair.drapes.style["length_m"]
        assert 0.3 <= pair.drapes.style["length_m"] <= 0.55
    assert [lengths[each] for each in sorted(lengths)] == sorted(lengths.values())
    about = json.loads((folder / "styles.json").read_text())["style_space"]
    assert [each["name"] for each in about["components"]] == ["longer", "broader"]
    assert about["cosines"][0] > 0.97
    lost = folder / "round-2" / "000003.npz"
    lost.unlink()
    (folder / "canonical.npz").unlink()
    assert stage.run(folder, TIES).digest == digest
    assert lost.is_file()
