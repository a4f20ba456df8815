"""Kernels tuned by leaving out takes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from capture4d.learning.kernels import likeness
from capture4d.types import PoseSequence
from retarget.config import ControlConfig, KernelConfig, KernelTuningConfig
from retarget.regression.controls import ControlLayout, control_vectors
from retarget.regression.kernel import KernelRegressor, fit_kernel
from retarget.regression.kernel_tuning import Fold
from retarget.regression.kernel_views import kernel_views
from retarget.regression.regressors import Clip, FittingClips, mean_squared_error

NAMES = ("root", "spine", "arm.L", "arm.R", "neck")
CHOSEN = ControlLayout(NAMES, (1, 2, 3, 4), 60.0, ControlConfig(root_motion=False))
UNTUNED = KernelConfig(ridges=(1e-2,), tuning=KernelTuningConfig(enabled=False))
TUNED = replace(UNTUNED, tuning=KernelTuningConfig())


def take(number: int, frames: int = 40) -> Clip:
    """Arms bend the garment, each its own side; the neck turns as far and does nothing."""
    rng = np.random.default_rng(number)
    angles = rng.uniform(0.2, 1, 3) * np.sin(rng.uniform(0, 6, 3) + np.linspace(0, 3, frames)[:, None])
    rotations = np.tile(np.eye(3, dtype=np.float32), (frames, 5, 1, 1))
    for joint, angle in zip((2, 3, 4), angles.T, strict=True):
        rotations[:, joint] = Rotation.from_euler("z", angle[:, None]).as_matrix()
    still, shape = np.zeros((frames, 3), np.float32), np.zeros(2, np.float32)
    poses = PoseSequence(rotations, still, shape, np.arange(frames, dtype=np.int32), 60.0, NAMES)
    wanted = np.stack([np.cos(3 * angles[:, 0]), np.cos(3 * angles[:, 1])], axis=1).astype(np.float32)
    return Clip(control_vectors(CHOSEN, poses), wanted, np.ones(frames, bool), number)


def fitted(clips: list[Clip], config: KernelConfig) -> KernelRegressor:
    return fit_kernel(FittingClips.create(clips), CHOSEN, np.ones(2), config)


def test_a_control_that_tells_nothing_counts_less_and_unseen_takes_are_foretold_better() -> None:
    learned, unseen = [take(number) for number in range(6)], [take(number) for number in range(20, 26)]
    before, after = fitted(learned, UNTUNED), fitted(learned, TUNED)
    assert mean_squared_error(after, unseen) < 0.8 * mean_squared_error(before, unseen)

    def counts(found: KernelRegressor) -> np.ndarray:
        """How far everything moves with each joint."""
        return np.linalg.norm(found.views[0].reshape(4, -1), axis=1)

    assert counts(after)[3] / counts(after)[1] < 0.8 * counts(before)[3] / counts(before)[1]
    ratio = np.linalg.norm(after.views[0], axis=1) / np.maximum(np.linalg.norm(before.views[0], axis=1), 1e-12)
    np.testing.assert_allclose(ratio[6:12][ratio[6:12] > 0], ratio[6], rtol=1e-4)  # a joint is one control,
    np.testing.assert_allclose(ratio[12], ratio[6], rtol=1e-4)  # and so are both arms


@pytest.mark.parametrize("takes", [1, 2])
def test_few_takes_leave_the_kernels_as_they_are(takes: int) -> None:
    learned = [replace(take(number), take=number % takes) for number in range(4)]
    before, after = fitted(learned, UNTUNED), fitted(learned, TUNED)
    np.testing.assert_array_equal(after.shares, before.shares)
    np.testing.assert_array_equal(after.answers, before.answers)


def test_tuning_looks_at_no_more_frames_than_allowed_and_restraint_holds_it_back() -> None:
    learned = [take(number) for number in range(4)]
    before = fitted(learned, UNTUNED)

    def moved(**settings: float) -> float:
        """How far the kernels' weights are from untuned ones."""
        tuning = KernelTuningConfig(rounds=3, **settings)
        found = fitted(learned, replace(UNTUNED, tuning=tuning))
        assert len(found.frames) == 160
        return float(np.abs(np.log(found.shares / before.shares)).max())

    assert moved(restraint=1e4) < 1e-3 < 0.1 < moved()
    assert moved(frames=40) != moved()


def test_the_linear_kernel_goes_on_where_no_learned_frame_is_near() -> None:
    learned = [take(number) for number in range(4)]
    for clip in learned:
        clip.coefficients[:] = clip.controls[:, 6:8]
    far = [replace(clip, controls=3 * clip.controls, coefficients=3 * clip.coefficients) for clip in learned]
    curved, straight = (
        fitted(learned, replace(UNTUNED, tuning=KernelTuningConfig(line=line, restraint=1e3))) for line in (0.0, 100.0)
    )
    assert fitted(learned, UNTUNED).line == curved.line == 0 < straight.line
    assert mean_squared_error(straight, far) < 0.1 * mean_squared_error(curved, far)


def test_tuning_foretells_with_the_kernels_that_are_learned_with() -> None:
    """What is tuned, and the regression that comes of it, are one and the same: errors of a take that is left out."""
    clips = [take(number) for number in range(3)]
    kept, out = (np.concatenate([clip.controls for clip in each]) for each in (clips[:2], clips[2:]))
    wanted = np.concatenate([clip.coefficients for clip in clips]).astype(np.float64)
    known = np.concatenate([kept, out]) - kept.mean(axis=0)
    views = kernel_views(known[:80], wanted[:80] - wanted[:80].mean(axis=0), CHOSEN, UNTUNED)
    rng = np.random.default_rng(0)
    controls, widths, shares, line = (
        rng.uniform(0.5, 2, CHOSEN.size),
        rng.uniform(0.5, 2, 3),
        rng.uniform(0.5, 2, 3),
        0.3,
    )
    fold = Fold.create(np.arange(120) >= 80, views)
    tensors = (torch.from_numpy(each) for each in (known * controls, wanted, widths, shares))
    found = fold.squared_error(*tensors, torch.tensor(line), 0.1)

    tuned = views.tuned(controls, widths, shares, line)
    seen = [known.astype(np.float64) @ view for view in tuned.matrices]
    alike = likeness(seen, seen, tuned.weights, tuned.line)
    middle = wanted[:80].mean(axis=0)
    answers = np.linalg.solve(alike[:80, :80] + 0.1 * np.eye(80), wanted[:80] - middle)
    errors = alike[80:, :80] @ answers + middle - wanted[80:]
    assert float(found) == pytest.approx((errors**2).sum(axis=1).mean(), rel=1e-8)
