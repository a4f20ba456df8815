"""Curves of a cage from sparse markers: piecewise cubic, through all markers, as long in between as the cloth is.

The curve is Hermite's, parametrised by the length of cloth s; its free numbers are the tangents T at the markers. They
minimise the bending energy, the integral of |x''|^2 ds, as a cubic spline does, and in addition

    w sum over segments of ((length of the curve - length of cloth) / length of cloth)^2

with a weight that grows until it decides. Where markers are farther apart than the cloth is long between them it is
stretched: such a segment has no length to keep, and counts with that of its chord.

Letters: M markers, S segments (M - 1, or M of a closed curve), N vertices of a curve.

References: Jin et al., A pixel-based framework for data-driven clothing, SCA 2020, appendix C, which names the problem
and no method.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float, Float64, Integer
from scipy.optimize import least_squares

from capture4d.errors import InputError
from capture4d.geometry.mesh import normalised

__all__ = ["MarkerCurve", "curve_through", "fill_curve"]

WEIGHTS = (10.0, 1e3, 1e5)
"""Of the lengths, one after the other: from the spline the curve bows out by and by. With the last one lengths that can
be kept are kept to a ten-thousandth."""
GAUSS = 12
"""Nodes of the quadrature of a segment's length."""
NUDGE = 0.05
"""Markers in a line give no direction to bow in: before each weight the tangents are turned by this share of what
the slack asks for."""


@dataclass(frozen=True, slots=True, eq=False)
class MarkerCurve:
    """Hermite's curve through markers."""

    points: Float64[np.ndarray, "knots 3"]
    """The markers; of a closed curve the first once more at the end."""
    tangents: Float64[np.ndarray, "knots 3"]
    """dx/ds at the markers."""
    spans: Float64[np.ndarray, " S"]
    """Of the parameter between neighbouring markers: the length of cloth, or the chord of what is stretched."""
    arc: Float64[np.ndarray, " knots"]
    """Length of cloth from the first marker, metres."""

    def __call__(self, arc: Float[np.ndarray, " places"]) -> Float64[np.ndarray, "places 3"]:
        """Positions at lengths of cloth from the first marker."""
        segment = np.clip(np.searchsorted(self.arc, arc, side="right") - 1, 0, len(self.arc) - 2)
        span = np.diff(self.arc)[segment]
        blend = _hermite((arc - self.arc[segment]) / span)
        return np.einsum("kn,knc->nc", blend, self._controls(segment))

    def lengths(self) -> Float64[np.ndarray, " S"]:
        """Of the curve between neighbouring markers, metres."""
        controls = self._controls(np.arange(len(self.spans)))
        return _Segments.speeds(controls)[1]

    def _controls(self, segment: np.ndarray) -> np.ndarray:
        """Start, its tangent, end, its tangent of segments, (4, N, 3)."""
        first, second, span = self.tangents[segment], self.tangents[segment + 1], self.spans[segment]
        return np.stack([self.points[segment], span[:, None] * first, self.points[segment + 1], span[:, None] * second])


def curve_through(
    markers: Float[np.ndarray, "M 3"],
    lengths: Float[np.ndarray, " S"],
    *,
    closed: bool = False,
    bow: Float[np.ndarray, "3"] | None = None,
) -> MarkerCurve:
    """The smooth curve through markers that keeps the lengths of the cloth between them.

    Args:
        lengths: of the cloth from each marker to the next, metres; of a closed curve also from the last to the first.
        bow: direction in which a curve between markers in a line starts to bow; any across it if None.
    Raises:
        InputError: fewer than two markers (three of a closed curve), or not one positive length a segment.
    """
    points = np.asarray(markers, np.float64)
    wanted = np.asarray(lengths, np.float64)
    least = 3 if closed else 2
    if len(points) < least or len(wanted) != len(points) - (not closed):
        raise InputError(f"markers: expected {least} or more and a length for every segment, found {len(points)} and "
                         f"{len(wanted)} lengths")  # fmt: skip
    if not (np.isfinite(points).all() and (wanted > 0).all()):
        raise InputError("markers: expected finite places and positive lengths between them")
    knots = np.concatenate([points, points[:1]]) if closed else points
    chords = np.linalg.norm(np.diff(knots, axis=0), axis=1)
    segments = _Segments(knots, np.maximum(wanted, chords), wanted > chords, closed)
    tangents = segments.spline()
    slack = float(np.clip(1 - chords / wanted, 0, 1).mean())
    signs = np.where(np.arange(len(tangents)) % 2 == 0, 1.0, -1.0)[:, None]
    nudge = NUDGE * np.sqrt(6 * slack) * signs * _across(normalised(np.diff(knots, axis=0)), bow)
    for weight in WEIGHTS:
        found = least_squares(
            partial(segments.residuals, weight=weight),
            (tangents + nudge).ravel(),
            jac=partial(segments.jacobian, weight=weight),  # pyright: ignore[reportArgumentType]
            max_nfev=40,
        )
        tangents = found.x.reshape(-1, 3)
    every = np.concatenate([tangents, tangents[:1]]) if closed else tangents
    return MarkerCurve(knots, every, np.maximum(wanted, chords), np.concatenate([[0.0], np.cumsum(wanted)]))


def fill_curve(
    arc: Float[np.ndarray, " N"],
    marked: Integer[np.ndarray, " M"],
    markers: Float[np.ndarray, "M 3"],
    *,
    around: float | None = None,
    bow: Float[np.ndarray, "3"] | None = None,
) -> Float64[np.ndarray, "N 3"]:
    """Places of all vertices of a cage's curve from those of some.

    Args:
        arc: length of cloth from the curve's first vertex to each, ascending, metres.
        marked: which of the vertices are markers, ascending; of an open curve the first and the last among them.
        around: length of a closed curve; None is an open one.
        bow: as `curve_through` has it.
    Raises:
        InputError: markers that are not in order, or do not hold the ends of an open curve.
    """
    at = np.asarray(arc, np.float64)[marked]
    if (np.diff(at) <= 0).any() or (around is None and (at[0] > arc[0] or at[-1] < arc[-1])):
        raise InputError("markers: expected them in order along the curve, with both its ends, found others")
    lengths = np.diff(at) if around is None else np.diff(np.append(at, at[0] + around))
    curve = curve_through(markers, lengths, closed=around is not None, bow=bow)
    along = np.asarray(arc, np.float64) - at[0]
    return curve(along if around is None else along % around)


def _hermite(u: np.ndarray) -> np.ndarray:
    """Cubic Hermite functions of start, start tangent, end, end tangent, (4, N)."""
    return np.stack([1 - 3 * u**2 + 2 * u**3, u - 2 * u**2 + u**3, 3 * u**2 - 2 * u**3, u**3 - u**2])


def _hermite_slopes(u: np.ndarray) -> np.ndarray:
    return np.stack([6 * u**2 - 6 * u, 1 - 4 * u + 3 * u**2, 6 * u - 6 * u**2, 3 * u**2 - 2 * u])


def _hermite_bends(u: np.ndarray) -> np.ndarray:
    return np.stack([12 * u - 6, 6 * u - 4, 6 - 12 * u, 6 * u - 2])


def _nodes(count: int) -> tuple[np.ndarray, np.ndarray]:
    place, weight = np.polynomial.legendre.leggauss(count)
    return (place + 1) / 2, weight / 2


class _Segments:
    """Bending and lengths of a curve as functions of its tangents."""

    def __init__(self, knots: np.ndarray, lengths: np.ndarray, kept: np.ndarray, closed: bool) -> None:
        self.knots, self.wanted, self.kept = knots, lengths, kept
        count = len(lengths)
        self.free = count if closed else count + 1
        self.first = np.arange(count)
        self.second = (self.first + 1) % self.free
        # |x''|^2 ds over a segment, made free of units by the mean length; x'' is linear, so two nodes are exact
        place, weight = _nodes(2)
        scale = np.sqrt(lengths.mean() * weight[:, None] / lengths[None] ** 3)  # (2, S)
        bends = _hermite_bends(place)  # (4, 2)
        at_rest = bends[0][:, None, None] * knots[:-1] + bends[2][:, None, None] * knots[1:]  # (2, S, 3)
        self.bend_offset = (scale[..., None] * at_rest).reshape(-1)
        rows = np.zeros((2, count, self.free))
        for node in range(2):
            np.add.at(rows[node], (self.first, self.first), scale[node] * lengths * bends[1, node])
            np.add.at(rows[node], (self.first, self.second), scale[node] * lengths * bends[3, node])
        self.bend = rows.reshape(-1, self.free)

    def spline(self) -> np.ndarray:
        """Tangents with the least bending: the natural, or periodic, cubic spline's."""
        offset = self.bend_offset.reshape(-1, 3)
        return np.linalg.lstsq(self.bend, -offset, rcond=None)[0]

    @staticmethod
    def speeds(controls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Directions at the nodes, (Q, S, 3), and lengths, (S,), of segments with controls (4, S, 3)."""
        place, weight = _nodes(GAUSS)
        velocity = np.einsum("kq,ksc->qsc", _hermite_slopes(place), controls)
        speed = np.linalg.norm(velocity, axis=-1)
        return velocity / np.maximum(speed, 1e-12)[..., None], weight @ speed

    def _measured(self, tangents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        span = self.wanted[:, None]
        controls = np.stack(
            [self.knots[:-1], span * tangents[self.first], self.knots[1:], span * tangents[self.second]]
        )
        return self.speeds(controls)

    def residuals(self, free: np.ndarray, weight: float) -> np.ndarray:
        tangents = free.reshape(-1, 3)
        bending = (self.bend @ tangents).reshape(-1) + self.bend_offset
        return np.concatenate([bending, np.sqrt(weight) * self.kept * (self._measured(tangents)[1] / self.wanted - 1)])

    def jacobian(self, free: np.ndarray, weight: float) -> np.ndarray:
        place, weights = _nodes(GAUSS)
        slopes = _hermite_slopes(place)
        directions, _ = self._measured(free.reshape(-1, 3))
        lengths = np.zeros((len(self.wanted), self.free, 3))
        for end, basis in ((self.first, 1), (self.second, 3)):  # d length / d T, over the length of cloth
            np.add.at(lengths, (self.first, end), np.einsum("q,qsc->sc", weights * slopes[basis], directions))
        bending = np.kron(self.bend, np.eye(3))
        return np.concatenate(
            [bending, np.sqrt(weight) * (self.kept[:, None, None] * lengths).reshape(len(lengths), -1)]
        )


def _across(chords: np.ndarray, bow: np.ndarray | None) -> np.ndarray:
    """A unit vector across the mean chord, near `bow`."""
    along = normalised(chords.sum(axis=0)) if np.linalg.norm(chords.sum(axis=0)) > 1e-6 else chords[0]
    wanted = np.eye(3)[np.abs(along).argmin()] if bow is None else np.asarray(bow, np.float64)
    across = wanted - (wanted @ along) * along
    return normalised(across) if np.linalg.norm(across) > 1e-9 else normalised(np.cross(along, (0.3, 0.5, 0.8)))
