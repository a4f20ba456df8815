"""Synthetic takes with their registrations, made once and kept in the user's cache folder."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from benchmarks.cached_takes import cached_take, one_maker
from benchmarks.renewal import renew
from capture4d import pipeline
from capture4d.cache import user_cache_folder
from data_synth.config import PRESETS, SynthConfig

__all__ = ["QUICK_TAKE", "locate_texels", "registered_work"]

QUICK_TAKE = replace(PRESETS["tiny"], frames=12, capture_every=1)
"""The small take that other benchmarks use as well."""


def registered_work(config: SynthConfig, *, workers: int) -> tuple[Path, Path]:
    """The capture of a configuration, and a work folder with its garments and registration."""
    capture = cached_take(config, workers=workers)
    work = user_cache_folder() / "works" / capture.name
    with one_maker(work):
        renew(partial(pipeline.run, capture, work, draw=False, workers=workers))
    return capture, work


def locate_texels(texel_uv: np.ndarray, fine_uv: np.ndarray, *, candidates: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """The face of the simulated garment under points of the pattern, and their barycentrics in it.

    Args:
        texel_uv: (N, 2) places on the pattern, metres.
        fine_uv: (F, 3, 2) of the simulated garment, in the same plane.
    """
    near = np.asarray(KDTree(fine_uv.mean(axis=1)).query(texel_uv, k=candidates)[1])
    a, b, c = (fine_uv[near, corner].astype(float) for corner in range(3))
    p = texel_uv[:, None]

    def area(u: np.ndarray, v: np.ndarray, w: np.ndarray) -> np.ndarray:
        return (v[..., 0] - u[..., 0]) * (w[..., 1] - u[..., 1]) - (v[..., 1] - u[..., 1]) * (w[..., 0] - u[..., 0])

    weights = np.stack([area(p, b, c), area(a, p, c), area(a, b, p)], axis=-1) / area(a, b, c)[..., None]
    rows, best = np.arange(len(near)), weights.min(axis=-1).argmax(axis=1)
    chosen = np.clip(weights[rows, best], 0, None)
    return near[rows, best], chosen / chosen.sum(axis=1, keepdims=True)
