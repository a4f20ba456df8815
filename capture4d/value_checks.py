"""What values must be: each check raises an InputError that says what was expected and what was found."""

from __future__ import annotations

from typing import Any

import numpy as np

from capture4d.errors import InputError, NotFiniteError

__all__ = [
    "LARGEST_RATE",
    "SMALLEST_RATE",
    "outside",
    "require_array",
    "require_finite",
    "require_frame_rate",
    "require_frames",
    "require_indices",
    "require_loop",
    "require_names",
    "require_rotations",
    "require_weights",
]

SMALLEST_RATE, LARGEST_RATE = 0.01, 100_000.0
"""Frames a second that are believed: from one in a minute or two to what high-speed cameras do."""
_ROTATION = 2e-3
"""What rotations may err, as entries of R^T R - I: other people's are rounded to three digits."""
_SUM = 1e-3
"""What weights that sum to 1 may err."""


def require_frame_rate(owner: str, fps: float) -> None:
    """Raises InputError where a frame rate is none."""
    if not SMALLEST_RATE <= fps <= LARGEST_RATE:
        expected = f"a frame rate from {SMALLEST_RATE:g} to {LARGEST_RATE:g}"
        raise InputError(f"{owner}: expected {expected}, found {fps:g}")


def require_array(owner: str, name: str, value: Any, shape: tuple[int | None, ...], dtype: type) -> None:
    if not isinstance(value, np.ndarray) or value.dtype != np.dtype(dtype):
        found = value.dtype if isinstance(value, np.ndarray) else type(value).__name__
        raise InputError(f"{owner}.{name}: expected an array of {np.dtype(dtype)}, found {found}")
    fits = value.ndim == len(shape) and all(
        want is None or want == have for want, have in zip(shape, value.shape, strict=True)
    )
    if not fits:
        expected = "(" + ", ".join("*" if want is None else str(want) for want in shape) + ")"
        raise InputError(f"{owner}.{name}: expected shape {expected}, found {value.shape}")


def require_finite(owner: str, name: str, value: np.ndarray) -> None:
    if not np.isfinite(value).all():
        bad = int(np.count_nonzero(~np.isfinite(value).reshape(len(value), -1).all(axis=1)))
        raise NotFiniteError(f"{owner}.{name}: expected finite numbers, found NaN or inf in {bad} of {len(value)} rows")


def outside(indices: np.ndarray, count: int) -> bool:
    """Whether whole numbers, at least one, are not all from 0 to below a count; signed ones in one pass."""
    if indices.dtype == np.int32 and count < 2**31:
        return int(indices.view(np.uint32).max()) >= count
    return bool(indices.min() < 0 or indices.max() >= count)


def require_indices(owner: str, name: str, value: np.ndarray, count: int) -> None:
    if value.size and outside(value, count):
        found = int(value.min()) if value.min() < 0 else int(value.max())
        raise InputError(f"{owner}.{name}: expected indices from 0 to {count - 1}, found {found}")


def require_rotations(owner: str, name: str, value: np.ndarray) -> None:
    """Matrices (..., 3, 3) that turn, and neither scale nor mirror."""
    flat = value.reshape(-1, 3, 3)
    error = np.abs(np.einsum("nki,nkj->nij", flat, flat) - np.eye(3, dtype=flat.dtype)).reshape(len(flat), 9)
    turned = np.einsum("ni,ni->n", np.cross(flat[:, 0], flat[:, 1]), flat[:, 2])
    wrong = np.flatnonzero(~(error.max(axis=1, initial=0) <= _ROTATION) | ~(turned > 0))
    if len(wrong):
        frame, joint = divmod(int(wrong[0]), max(value.shape[1], 1))
        found = "a reflection" if turned[wrong[0]] < 0 else f"a matrix {error[wrong[0]].max():.2g} off"
        raise InputError(f"{owner}.{name}: expected rotations, found {found} in row {frame}, joint {joint}")


def require_weights(owner: str, name: str, value: np.ndarray) -> None:
    """Rows that share out 1."""
    require_finite(owner, name, value)
    off = np.abs(value.sum(axis=1, dtype=np.float64) - 1)
    if off.max(initial=0) > _SUM:
        row = int(off.argmax())
        raise InputError(f"{owner}.{name}: expected rows that sum to 1, found {value[row].sum():.4g} in row {row}")
    if value.min(initial=0) < -_SUM:
        raise InputError(f"{owner}.{name}: expected no negative weights, found {value.min():.4g}")


def require_frames(owner: str, frame_ids: np.ndarray) -> None:
    """Numbers from 0 up, each once."""
    if len(np.unique(frame_ids)) != len(frame_ids):
        raise InputError(f"{owner}.frame_ids: expected every frame once, found duplicates")
    if frame_ids.min(initial=0) < 0:
        raise InputError(f"{owner}.frame_ids: expected frame numbers from 0, found {frame_ids.min()}")


def require_names(owner: str, name: str, value: tuple[str, ...]) -> None:
    """Texts, each once."""
    strange = [each for each in value if not isinstance(each, str)]
    if strange:
        raise InputError(f"{owner}.{name}: expected texts, found {strange[0]!r}"[:200])
    if len(set(value)) < len(value):
        twice = next(each for row, each in enumerate(value) if each in value[:row])
        raise InputError(f"{owner}.{name}: expected every name once, found {twice[:80]!r} again")


def require_loop(name: str, loop: np.ndarray) -> None:
    if len(loop) < 3 or len(np.unique(loop)) < len(loop):
        found = f"{len(loop)}" if len(loop) < 3 else "one that is there twice"
        raise InputError(f"Garment.loops[{name!r}]: expected at least 3 vertices, once each, found {found}")
