"""Which pairs there are: the grid, prototypes against a search by hand, tests that are nobody's prototypes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from capture4d.errors import InputError
from data_synth.styles.config import STYLE_SETS, StyleSetConfig
from data_synth.styles.pairs import choose_prototypes, draw_test_pairs, grid, require_possible

CONFIG = StyleSetConfig(
    styles={"length": (0.4, 0.6, 0.8), "ease": (0.05, 0.2)}, shapes=((0.0, 0.0), (1.0, 0.0), (0.0, -1.0))
)


def test_the_grid_has_every_pair_and_begins_with_the_middle_style_on_everybody():
    pairs = grid(CONFIG)
    assert len(set(pairs)) == 3 * 2 * 3
    assert [pair.style for pair in pairs[:3]] == [(0.6, 0.05)] * 3
    assert [pair.shape for pair in pairs[:3]] == [*CONFIG.shapes]
    assert pairs[0].style_texts(CONFIG) == ("length=0.6", "ease=0.05")


def test_presets_are_possible_and_the_large_one_is_the_papers_grid():
    for config in STYLE_SETS.values():
        require_possible(config)
    assert len(grid(STYLE_SETS["tshirt-styles"])) == 25 * 9


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"styles": {"sleeve_length": (0.1, 0.2)}}, "expected numbers of a trousers, size, ease, .* 'sleeve_length'"),
        ({"styles": {"length": (0.5, 0.5)}}, "styles.length: expected two or more ascending values"),
        ({"styles": {}}, "expected at least one number that varies"),
        ({"shapes": ((1.0,), (0.0,))}, "shapes: expected the mean person first"),
        ({"prototypes": 17, "test_pairs": 2}, "expected at most the 18 pairs of styles and shapes, found 19"),
        ({"seen_poses": 20, "poses": 10}, "seen_poses: expected at most the 10 poses, found 20"),
    ],
)
def test_what_cannot_be_is_said(changes: dict, said: str):
    with pytest.raises(InputError, match=said):
        require_possible(replace(CONFIG, **changes))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_prototypes_come_near_all_and_one_pair_is_the_better_start(seed: int):
    """Pairs that are bilinear in style and shape: four corners span them all."""
    rng = np.random.default_rng(seed)
    fields = rng.normal(size=(3, 30, 3))
    places = [(style, shape) for style in (0.0, -1.0, 1.0) for shape in (0.0, -1.0, 1.0, 0.5)]
    pool = np.array([style * fields[0] + shape * fields[1] + style * shape * fields[2] for style, shape in places])
    chosen, errors = choose_prototypes(pool, 5, "one", 4)
    assert chosen[0] == 0
    assert {places[k] for k in chosen[1:]} == {(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)}
    assert errors[-1][0] < 1e-4
    shapes, later = choose_prototypes(pool, 5, "shapes", 4)
    assert shapes[:4] == [0, 1, 2, 3]
    assert later[-1][0] > 0.1  # the worst is still far: four of five are of one style


def test_test_pairs_are_no_prototypes_and_some_are_between_the_values():
    pairs = grid(CONFIG)
    drawn = set()
    for seed in range(12):
        chosen, off_grid = draw_test_pairs(replace(CONFIG, test_pairs=3, off_grid=2), pairs, [0, 4, 9],
                                      np.random.default_rng(seed))  # fmt: skip
        assert len(set(chosen)) == 3
        assert not {0, 4, 9} & set(chosen)
        drawn |= set(chosen)
        for pair in off_grid:
            assert 0.4 <= pair.style[0] <= 0.8
            assert 0.05 <= pair.style[1] <= 0.2
            assert 0 <= pair.shape[0] <= 1
            assert -1 <= pair.shape[1] <= 0
            assert pair not in pairs
    assert len(drawn) > 10  # any can be
