"""Statistics of unposed frames: laws, and slow references."""

import numpy as np
import pytest

from capture4d.body.skinning import skin
from capture4d.errors import InputError
from retarget.config import ShapeConfig
from retarget.shapes.blendshapes import (
    ShapeSpace,
    fewest_directions,
    learn_shape_space,
    posed_errors,
    project,
    reconstruct,
    skin_frames,
    through_garment,
    worst_errors,
)


def low_rank(frames: int = 40, verts: int = 30, rank: int = 5, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    mean = rng.standard_normal((verts, 3))
    strengths = 0.1 * 0.6 ** np.arange(rank)
    mix = rng.standard_normal((frames, rank)) * strengths
    directions = np.linalg.qr(rng.standard_normal((3 * verts, rank)))[0].T
    return mean + (mix @ directions).reshape(frames, verts, 3), mean


def learned(frames: np.ndarray, weights: np.ndarray | None = None, **settings) -> ShapeSpace:
    weights = np.ones(frames.shape[:2]) if weights is None else weights
    return learn_shape_space(frames, weights, np.arange(len(frames)), ShapeConfig(**settings), np.random.default_rng(1))


def test_corrected_projection_reproduces_full_rank_data_and_the_printed_one_misses_by_the_mean() -> None:
    frames = np.random.default_rng(2).standard_normal((12, 9, 3))
    space = learned(frames, method="exact")
    assert len(space.basis) == 11  # the mean takes one
    again = reconstruct(space.mean, space.basis, project(space, frames))
    np.testing.assert_allclose(again, frames, atol=1e-12)
    printed = reconstruct(space.mean, space.basis, project(space, frames, formula="printed"))
    flat = space.basis.reshape(11, -1)
    twice = flat.T @ (flat @ space.mean.ravel())
    np.testing.assert_allclose(printed - frames, np.broadcast_to(twice.reshape(9, 3), frames.shape), atol=1e-12)
    assert np.abs(printed - frames).max() > 0.1


def test_directions_are_orthonormal_and_their_spread_is_that_of_the_coefficients() -> None:
    frames, _ = low_rank()
    space = learned(frames)
    flat = space.basis.reshape(len(space.basis), -1)
    np.testing.assert_allclose(flat @ flat.T, np.eye(len(flat)), atol=1e-10)
    np.testing.assert_allclose(project(space, frames).std(axis=0), space.std, rtol=1e-9)
    assert (np.diff(space.std) <= 0).all()
    assert len(space.basis) == 5


def test_one_more_direction_reaches_a_garment_that_was_never_learned() -> None:
    frames, mean = low_rank()
    space, rows = learned(frames, components=3), np.arange(len(frames))
    garment = mean + 0.2 * np.random.default_rng(8).standard_normal(mean.shape)
    wider = through_garment(space, garment, frames, rows)
    assert len(wider.basis) == 4
    flat = wider.basis.reshape(4, -1)
    np.testing.assert_allclose(flat @ flat.T, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(
        reconstruct(wider.mean, wider.basis, project(wider, garment[None]))[0], garment, atol=1e-12
    )
    np.testing.assert_allclose(np.sqrt((project(wider, frames)[:, -1] ** 2).mean()), wider.std[-1], rtol=1e-9)
    assert through_garment(wider, garment, frames, rows) is wider, "it is in the space already"


@pytest.mark.parametrize("decay", ["steep", "flat"])
def test_randomised_equals_plain(decay: str) -> None:
    rng = np.random.default_rng(3)
    scale = 0.8 ** np.arange(150) if decay == "steep" else 1 / (1 + np.arange(150)) ** 0.7
    matrix = (rng.standard_normal((150, 150)) * scale) @ np.linalg.qr(rng.standard_normal((360, 150)))[0].T
    frames = matrix.reshape(150, 120, 3)
    plain, quick = (learned(frames, method=method, components=20) for method in ("exact", "randomised"))
    np.testing.assert_allclose(quick.std, plain.std, rtol=1e-5)
    np.testing.assert_allclose(quick.basis, plain.basis, atol=1e-5)


def test_reading_block_by_block_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    frames, _ = low_rank()
    weights = np.ones(frames.shape[:2])
    weights[3:9, :7] = 0.0
    whole = [learned(frames, weights, method=method) for method in ("exact", "randomised")]
    monkeypatch.setattr("capture4d.learning.principal_directions.BLOCK_NUMBERS", 7 * frames[0].size)
    for method, expected in zip(("exact", "randomised"), whole, strict=True):
        found = learned(frames, weights, method=method)
        np.testing.assert_allclose(found.basis, expected.basis, atol=1e-8)


def test_unseen_vertices_are_filled_in_not_believed() -> None:
    frames, _ = low_rank(frames=60, rank=3)
    rng = np.random.default_rng(4)
    weights = np.where(rng.random(frames.shape[:2]) < 0.15, 0.02, 1.0)
    spoilt = np.where((weights < 1)[..., None], frames + 0.2 * rng.standard_normal(frames.shape), frames)
    believing = learned(spoilt, components=3)
    doubting = learned(spoilt, weights, components=3, filling_rounds=40)
    missing = weights < 1

    def error(space: ShapeSpace, known: np.ndarray) -> float:
        again = reconstruct(space.mean, space.basis, project(space, spoilt, known))
        return float(np.sqrt(((again - frames)[missing] ** 2).sum(axis=-1).mean()))

    assert error(doubting, weights) < 0.01
    assert error(believing, np.ones_like(weights)) > 5 * error(doubting, weights)


def test_a_frame_with_gaps_is_projected_as_least_squares_would() -> None:
    frames, _ = low_rank(rank=3)
    space = learned(frames)
    weights = np.ones(frames.shape[:2])
    weights[:, ::4] = 0.3
    rng = np.random.default_rng(5)
    noisy = frames + 0.01 * rng.standard_normal(frames.shape)
    found = project(space, noisy, weights)
    flat = space.basis.reshape(3, -1).T
    for row in range(3):
        root = np.sqrt(np.repeat(weights[row], 3))
        slow = np.linalg.lstsq(flat * root[:, None], (noisy[row] - space.mean).ravel() * root, rcond=None)[0]
        np.testing.assert_allclose(found[row], slow, atol=0.02 * space.std[0])


def test_the_fewest_directions_are_found_by_the_worst_vertex_in_the_pose() -> None:
    frames, _ = low_rank(frames=30, rank=8)
    rng = np.random.default_rng(6)
    weights, rows = np.ones(frames.shape[:2]), np.arange(30)
    skin_weights = rng.dirichlet(np.ones(2), frames.shape[1])
    transforms = np.tile(np.eye(4), (30, 2, 1, 1))
    transforms[:, :, :3, :3] *= 2.0  # a pose that doubles all lengths doubles the errors
    space = learned(frames)
    errors = worst_errors(space, frames, weights, rows, transforms, skin_weights, range(1, 9))
    for count in (2, 5):
        slow = frames - reconstruct(space.mean, space.basis[:count], project(space.first(count), frames))
        np.testing.assert_allclose(errors[count][1], 2 * np.linalg.norm(slow, axis=-1).max(), rtol=1e-9)
    limit = errors[5][1]
    found = fewest_directions(space, frames, weights, rows, transforms, skin_weights, limit_m=limit + 1e-12)
    assert found is not None
    assert errors[found][1] <= limit + 1e-12
    assert found <= 5
    assert fewest_directions(space.first(2), frames, weights, rows, transforms, skin_weights, limit_m=1e-9) is None


def test_skinning_many_frames_is_skinning_each() -> None:
    rng = np.random.default_rng(7)
    frames = rng.standard_normal((4, 50, 3)).astype(np.float32)
    weights = rng.dirichlet(np.ones(3), 50).astype(np.float32)
    transforms = np.tile(np.eye(4), (4, 3, 1, 1))
    transforms[:, :, :3] += 0.2 * rng.standard_normal((4, 3, 3, 4))
    found = skin_frames(frames, weights, transforms)
    for row in range(4):
        np.testing.assert_allclose(found[row], skin(frames[row], weights, transforms[row]), atol=2e-6)
    moved = frames + 0.01
    lengths = posed_errors((moved - frames).astype(float), weights, transforms)
    np.testing.assert_allclose(
        lengths, np.linalg.norm(skin_frames(moved, weights, transforms) - found, axis=-1), atol=2e-6
    )


def test_a_number_of_directions_asked_for_twice_is_measured_once() -> None:
    frames, _ = low_rank()
    space = learned(frames)
    skin_weights, transforms = np.ones((frames.shape[1], 1), np.float32), np.tile(np.eye(4), (len(frames), 1, 1, 1))
    known = (space, frames, np.ones(frames.shape[:2]), np.arange(len(frames)), transforms, skin_weights)
    assert worst_errors(*known, [2, 5, 2]) == worst_errors(*known, [5, 2])


def test_bad_numbers_are_one_line() -> None:
    frames, _ = low_rank()
    space = learned(frames)
    with pytest.raises(InputError, match="at least 2 good frames"):
        learned(frames[:1])
    with pytest.raises(InputError, match="4 that are all the same"):
        learned(np.repeat(frames[:1], 4, axis=0))
    with pytest.raises(InputError, match="NaN or inf in 1 of 2 frames"):
        reconstruct(space.mean, space.basis, np.array([[0.0], [np.nan]]))
    with pytest.raises(InputError, match="at most 5, found 6"):
        reconstruct(space.mean, space.basis, np.zeros((1, 6)))
    with pytest.raises(InputError, match="finite"):
        project(space, np.full_like(frames, np.nan))
