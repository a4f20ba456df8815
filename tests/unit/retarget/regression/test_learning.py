"""How far a regressor is believed is shown by takes that it has not seen."""

from dataclasses import dataclass

import numpy as np
import pytest

from retarget.config import ControlConfig
from retarget.regression.controls import ControlLayout, control_vectors
from retarget.regression.known_range import CoefficientRange
from retarget.regression.learning import examined
from retarget.regression.regressors import Clip, FittingClips


@dataclass(frozen=True)
class Remembered:
    """Answers the first three controls times a factor."""

    layout: ControlLayout
    factor: float

    def stream(self):
        raise NotImplementedError

    def predict(self, controls):
        return (self.factor * np.asarray(controls)[:, :3]).astype(np.float32)


@pytest.fixture
def layout(body) -> ControlLayout:
    return ControlLayout(body.joint_names, (1, 2), 60.0, ControlConfig(), (-1, 0, 1))


def clips(layout, motion, takes: int) -> list[Clip]:
    """Coefficients are the first three controls."""
    found = []
    for take in range(takes):
        controls = control_vectors(layout, motion(60, take))
        found.append(Clip(controls, controls[:, :3].copy(), np.ones(60, bool), take))
    return found


@pytest.mark.parametrize(("factor", "share"), [(1.0, 1.0), (2.0, 0.5), (-1.0, 0.0)])
def test_each_take_is_examined_by_the_others(layout, motion, factor: float, share: float) -> None:
    taught = clips(layout, motion, 3)
    seen: list[set[int]] = []

    def fit(known: FittingClips) -> Remembered:
        assert not known.validation
        seen.append({clip.take for clip in known.all})
        return Remembered(layout, factor)

    wide = CoefficientRange(np.ones(3, np.float32), np.full(3, 100, np.float32), 1e3)
    trust = examined(FittingClips.create(taught), layout, wide, 3, fit)
    assert seen == [{1, 2}, {0, 2}, {0, 1}]
    np.testing.assert_array_equal(trust.knots[0], (0, 1))
    np.testing.assert_allclose(trust.knots[1:, 1], share, atol=1e-5)
    assert trust.knots[1, 0] > 0, "takes that were not learned from lie some way off"


def test_an_only_take_is_examined_on_its_end(layout, motion) -> None:
    (clip,) = clips(layout, motion, 1)
    start, end = (Clip(clip.controls[part], clip.coefficients[part], clip.good[part])
                  for part in (slice(0, 40), slice(40, 60)))  # fmt: skip
    seen: list[int] = []

    def fit(known: FittingClips) -> Remembered:
        seen.append(sum(len(each.good) for each in known.all))
        return Remembered(layout, 4.0)

    wide = CoefficientRange(np.ones(3, np.float32), np.full(3, 100, np.float32), 1e3)
    trust = examined(FittingClips([start], [end], [start]), layout, wide, 3, fit)
    assert seen == [40]
    np.testing.assert_allclose(trust.knots[1:, 1], 0.25, atol=1e-5)
    whole = examined(FittingClips([start], [], [start]), layout, wide, 3, fit)
    np.testing.assert_array_equal(whole.knots, [[0, 1]])
