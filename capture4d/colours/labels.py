"""What a vertex is by its colour: garment, one of the paints, or anything else."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import UInt8

from capture4d.colours.spaces import Colour, linear_colours
from capture4d.heavy_imports import njit

__all__ = ["FIRST_PAINT", "GARMENT", "OTHER", "classify_colours", "settle_labels"]

OTHER, GARMENT, FIRST_PAINT = 0, 1, 2


MAX_ANGLE = 0.24
"""Largest angle between a colour and a paint in linear RGB, radians: shading under tinted light stays below 0.15."""


BRIGHTNESS_WEIGHT = 0.1
"""Where all colours are known: radians of angle that a factor e of brightness counts for."""


LIGHTNESS_RANGE = (0.12, 4.0)
"""Brightness relative to the paint's own that still counts as shading."""


def classify_colours(
    colours: UInt8[np.ndarray, "verts 3"],
    garment_colour: Colour,
    paints: tuple[Colour, ...],
    *,
    others: tuple[Colour, ...] = (),
) -> UInt8[np.ndarray, " verts"]:
    """0 for anything else, 1 for the garment, 2 and on for the paints, vertex by vertex."""
    table = _label_table(garment_colour, paints, others)
    quantised = (colours >> 2).astype(np.int32)
    return table[(quantised[:, 0] << 12) | (quantised[:, 1] << 6) | quantised[:, 2]]


@lru_cache(maxsize=8)
def _label_table(garment_colour: Colour, paints: tuple[Colour, ...], others: tuple[Colour, ...]) -> np.ndarray:
    """Labels of all colours at six bits per channel: classifying a scan is one look-up."""
    level = np.arange(64) * 4 + 2
    red, green, blue = np.meshgrid(level, level, level, indexing="ij")
    colours = linear_colours(np.stack([red, green, blue], axis=-1).reshape(-1, 3))
    brightness = np.linalg.norm(colours, axis=1)
    references = linear_colours(np.array([garment_colour, *paints, *others], np.float64))
    reference_brightness = np.maximum(np.linalg.norm(references, axis=1), 1e-4)
    cosine = (colours @ references.T) / np.maximum(brightness[:, None] * reference_brightness, 1e-9)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    ratio = brightness[:, None] / reference_brightness
    angle[(ratio < LIGHTNESS_RANGE[0]) | (ratio > LIGHTNESS_RANGE[1]) | (angle > MAX_ANGLE)] = np.inf
    nearest = np.argmin(angle + BRIGHTNESS_WEIGHT * np.abs(np.log(ratio + 1e-9)) * bool(others), axis=1)
    wanted = np.isfinite(angle.min(axis=1)) & (nearest <= len(paints))
    return np.where(wanted, nearest + 1, OTHER).astype(np.uint8)


def settle_labels(faces: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Two rounds of votes among neighbours: fills mixed colours between paints, and specks of the wrong one."""
    count = int(labels.max(initial=0)) + 1
    for _ in range(2):
        labels = vote(faces, labels, count)
    return labels


@njit(cache=True)
def vote(faces, labels, count):
    """Each vertex takes the label of most of its neighbours if at least two thirds agree, or if it has none itself."""
    votes = np.zeros((len(labels), count), np.int32)
    for f in range(len(faces)):
        for k in range(3):
            a, b = faces[f, k], faces[f, (k + 1) % 3]
            votes[a, labels[b]] += 1
            votes[b, labels[a]] += 1
    result = labels.copy()
    for v in range(len(labels)):
        best, total = 0, 0
        for label in range(count):
            total += votes[v, label]
            if votes[v, label] > votes[v, best]:
                best = label
        if 3 * votes[v, best] >= 2 * total and total > 0:
            result[v] = best
        elif labels[v] == 0:
            most = 0
            for label in range(1, count):
                if most == 0 or votes[v, label] > votes[v, most]:
                    most = label
            if most > 0 and 2 * votes[v, 0] <= total:
                result[v] = most
    return result
