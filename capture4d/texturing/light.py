"""How light and shade go by the direction in which cloth faces, told apart from what is printed on it.

Logarithms of colours are a sum: log c = log a(place) + log s(normal) + gain(frame). Lamps stand still, so that s is one
function of the world's directions for the whole take; here the spherical harmonics up to order 2, of each channel by
itself. What is printed somewhere is there in every frame: it is an effect of the place, of unknown size, normally
distributed over places, and frames are compared place by place; how far different places are compared as well follows
from how much more they differ than the same place does (generalised least squares of a panel with random effects:
Wooldridge, Econometric Analysis of Cross Section and Panel Data, 10.4). Normals of scans are noisy, which would make
the light look weaker than it is; those of the registered template, noisy in another way, are the instruments (ibid.,
5.1). How bright the light is as a whole cannot be
known: the mean over what was seen is 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64

__all__ = ["Light", "fit_light"]

DARKEST, BRIGHTEST = 6.0, 250.0
"""Levels that are taken for the darkest: logarithms of less are noise; and from which on a camera may have clipped."""
TOLD_SHARE = 0.1
"""A channel tells of light if more than so much of what was seen has not clipped; else its levels are left alone."""
PATCH_M2 = 0.03**2
"""Colours of cloth are alike over so much of it: places in one patch are one place, as far as comparing goes."""
ROUNDS = 4
ROBUST = 2.0
"""Residuals larger than so many standard deviations lose weight (Cauchy)."""
TERM_SPREAD, GAIN_SPREAD = 1.0, 0.1
"""Standard deviations of terms and of frames' gains before anything is seen: directions that nobody faces stay at 0."""
HUE_SPREADS = tuple(0.001 * 2.0**power for power in range(10))
"""Standard deviations of channels' terms around their mean that are tried: from one hue to none in common."""


@dataclass(frozen=True, slots=True, eq=False)
class Light:
    """Brightness by direction. K terms of the harmonics without the constant one."""

    terms: Float64[np.ndarray, "terms 3"]
    """Of the logarithm of sRGB, which is a power of light."""
    mean: Float64[np.ndarray, " 3"]
    """What the logarithm is in the mean over what was seen, and is taken off."""

    @staticmethod
    def even() -> Light:
        return Light(np.zeros((8, 3)), np.zeros(3))

    def at(self, normals: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """What sRGB values are multiplied by there, 1 in the mean of logarithms."""
        return np.exp(harmonics(normals) @ self.terms - self.mean)


def harmonics(normals: Float[np.ndarray, "*any 3"]) -> Float64[np.ndarray, "*any 8"]:
    """Real spherical harmonics of order 1 and 2, but for their constant factors."""
    x, y, z = np.moveaxis(normals.astype(np.float64), -1, 0)
    return np.stack([x, y, z, x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1], axis=-1)


def fit_light(
    colours: Float32[np.ndarray, "frames places 3"],
    normals: Float32[np.ndarray, "frames places 3"],
    smooth: Float32[np.ndarray, "frames places 3"],
    weights: Float32[np.ndarray, "frames places"],
    *,
    area_m2: float,
) -> tuple[Light, Float64[np.ndarray, "frames 3"]]:
    """The light of a take, and the gain of each frame.

    Args:
        colours: sRGB, 0 to 255, of the same places of the cloth in every frame.
        normals: of the scans there.
        smooth: of the registered template there.
        weights: 0 where nothing is seen.
        area_m2: of the cloth.
    Returns:
        The light; and by what each frame is brighter than the mean, as a logarithm. Both 0 in channels that have
        clipped nearly everywhere: what is flat has no shade that could be divided out.
    """
    frames, places = weights.shape
    terms = harmonics(normals)
    shown = np.broadcast_to(np.eye(frames)[:, None, :], (frames, places, frames))
    ones = np.ones((frames, places, 1))
    rows = np.concatenate([ones, terms, shown], axis=2)
    instruments = np.concatenate([ones, harmonics(smooth), shown], axis=2)
    alike = max(1.0, places * PATCH_M2 / max(area_m2, 1e-9))
    clear = np.where(colours < BRIGHTEST, weights[..., None], 0)
    told = np.flatnonzero(clear.sum(axis=(0, 1)) > TOLD_SHARE * weights.sum())
    fits = []
    for channel in told:
        values = np.maximum(colours[..., channel].astype(np.float64), DARKEST)
        # A level is the larger part of a logarithm the darker it is.
        precision = clear[..., channel] * (values / 255) ** 2
        fits.append(_random_effects(rows, instruments, np.log(values), precision, alike))
    found, gains = np.zeros((terms.shape[-1], 3)), np.zeros((frames, 3))
    if fits:
        found[:, told], gains[:, told] = _of_near_hue(fits, terms.shape[-1])
    # The same places for all channels: what is printed there decides of no hue. Those that have clipped, too: without
    # them it would be the mean over the shade, and cloth would come out too dark.
    mean = np.einsum("tp,tpk->k", weights, terms) @ found / max(float(weights.sum()), 1e-12)
    return Light(found, mean), gains - gains.mean(axis=0)


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """A channel's equations, matrix @ solution = right: a constant, the terms of light, a gain of each frame."""

    matrix: Float64[np.ndarray, "columns columns"]
    right: Float64[np.ndarray, " columns"]
    error: float
    """Variance: the solution's covariance is the matrix' inverse times it."""


def _of_near_hue(
    fits: Sequence[_Fit], count: int
) -> tuple[Float64[np.ndarray, "terms channels"], Float64[np.ndarray, "frames channels"]]:
    """Terms and gains of the channels, where lamps are of nearly one hue: terms are normally distributed around their
    mean over the channels, with the spread under which what was found is likeliest (restricted maximum likelihood:
    Searle, Casella, McCulloch, Variance Components, 6.6). What is printed is mistaken for light in each channel by
    itself; lamps of two hues show a spread.

    Args:
        count: of the terms.
    """
    at = np.arange(1, 1 + count)
    rest = np.setdiff1d(np.arange(len(fits[0].right)), at)
    found, spread = np.empty((len(fits), count)), np.empty((len(fits), count, count))
    for channel, fit in enumerate(fits):
        found[channel] = np.linalg.solve(fit.matrix, fit.right)[at]
        inverse = fit.error * np.linalg.inv(fit.matrix)[np.ix_(at, at)]
        values, axes = np.linalg.eigh((inverse + inverse.T) / 2)
        spread[channel] = (axes * np.maximum(values, 1e-10)) @ axes.T  # instruments leave it nearly symmetric

    def weights_of(hue: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Inverse covariances around the mean, the mean, and the logarithm of the likelihood."""
        weights = np.linalg.inv(spread + hue**2 * np.eye(count))
        total = weights.sum(axis=0)
        mean = np.linalg.solve(total, np.einsum("cij,cj->i", weights, found))
        away = found - mean
        misfit = float(np.einsum("ci,cij,cj->", away, weights, away))
        return weights, mean, float(np.linalg.slogdet(weights)[1].sum() - np.linalg.slogdet(total)[1]) - misfit

    hue = max(HUE_SPREADS, key=lambda each: weights_of(each)[2])
    weights, mean, _ = weights_of(hue)
    terms = mean + hue**2 * np.einsum("cij,cj->ci", weights, found - mean)
    gains = [
        np.linalg.solve(fit.matrix[np.ix_(rest, rest)], fit.right[rest] - fit.matrix[np.ix_(rest, at)] @ each)[1:]
        for fit, each in zip(fits, terms, strict=True)
    ]
    return terms.T, np.stack(gains, axis=1)


def _random_effects(
    rows: Float64[np.ndarray, "frames places columns"],
    instruments: Float64[np.ndarray, "frames places columns"],
    values: Float64[np.ndarray, "frames places"],
    precision: Float64[np.ndarray, "frames places"],
    alike: float,
) -> _Fit:
    """Equations of the coefficients of rows, where each place adds something of its own to all its values.

    With P the precisions of a place's values and k = A / (E + A sum P), the inverse of its covariance is
    (P - k P 1 1' P) / E; E the variance of a value of precision 1, A that of what places add, `alike` times as large
    for places that lie in one patch, of which so many know no more than one.
    """
    scale = precision.sum() / max(np.count_nonzero(precision), 1)
    base = precision / max(scale, 1e-12)
    weight, error, added = base, 0.02**2, 1.0
    ridge = np.full(rows.shape[-1], TERM_SPREAD**-2)
    ridge[0], ridge[-len(rows) :] = 1e-9, GAIN_SPREAD**-2
    fit = None
    for _ in range(ROUNDS):
        sums = weight.sum(axis=0)
        keep = added * alike / (error + added * alike * np.maximum(sums, 1e-12))
        by_place, told = (np.einsum("tp,tpc->pc", weight, each) for each in (rows, instruments))
        heavy = (instruments * weight[..., None]).reshape(-1, rows.shape[-1])
        matrix = heavy.T @ rows.reshape(heavy.shape) - (told * keep[:, None]).T @ by_place
        right = heavy.T @ values.reshape(-1) - told.T @ (keep * (weight * values).sum(axis=0))
        fit = _Fit(matrix + np.diag(ridge * error), right, error)
        solution = np.linalg.solve(fit.matrix, fit.right)
        residual = values - rows @ solution
        place = (weight * residual).sum(axis=0) / np.maximum(sums, 1e-12)
        left = np.where(weight > 0, residual - place, 0)
        seen = base > 0
        error = max(float((base[seen] * left[seen] ** 2).mean()), 1e-8)
        looked = sums > 0
        added = max(float(place[looked].var()), 1e-8) if looked.any() else 1e-8
        weight = base / (1 + base * left**2 / (ROBUST**2 * error))
    assert fit is not None
    return fit
