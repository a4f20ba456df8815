"""Are the UVs of a garment its sewing pattern?

The pattern knows how long the cloth is; charts that were cut out of a mesh do not, though those of a shirt, which is
nearly developable, keep its lengths to a few per cent. Two things tell them apart. Worn cloth is taut one way at nearly
every point and as long there as on the pattern, and shorter across, where it is folded; charts that keep angles grow
and shrink both ways at once. And panels are cut with scissors, while charts end along the edges of triangles, in
zigzags. The limits lie between the patterns and the atlases of several simulated shirts
(docs/notebook/registration.md).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64, Int32

from capture4d.errors import InputError
from capture4d.geometry.mesh import edge_lengths, face_areas, flat_edge_lengths, half_edges
from capture4d.geometry.tangents import TangentLayout, uv_corners
from capture4d.types import Garment, Mesh
from capture4d.units import METRES

__all__ = [
    "PatternFit",
    "as_pattern",
    "fit_pattern",
    "picture_span",
    "picture_uv",
    "rest_lengths",
    "with_known_pattern",
]

PANEL_SHARE = 0.02
"""Share of the surface from which on a chart is a panel whose scale counts; smaller ones are trimmings."""
PANEL_SCALES = 1.06
"""Largest ratio of the scales of two panels; those of simulated shirts reach 1.03, packed charts of an atlas any."""
TOLD_SCALES = 1.15
"""The same where somebody says that the UVs are the pattern."""
TAUT = (0.96, 1.13)
"""Where the 5th and the 95th percentile of the taut lengths may lie, over their median: 0.971 and 1.096 at the
outermost in patterns of simulated shirts with raised arms, 0.89 and 1.2 in box projections."""
LEAST_ACROSS = 0.85
"""Length across over taut length, median: worn cloth keeps 0.90 to 0.98. Less is an atlas that was squeezed to fit."""
CONFORMAL_ACROSS, CONFORMAL_SPREAD = 0.98, 1.06
"""Charts that keep angles have above 0.98, and taut lengths that vary by more than cloth without folds can explain."""
SHARP_DEG, SHARP_SHARE = 30.0, 0.25
"""Corners of an outline that turn by more than so much, and how many may: 5 to 12 % of panels', half of atlases'."""
UNIT_TOLERANCE = 0.06
"""How near the scale of a pattern has to be to a unit's to be in that unit."""


@dataclass(frozen=True, slots=True)
class PatternFit:
    """How the UVs of a mesh compare with a sewing pattern of what is worn."""

    metres: float
    """In a unit of the UVs, for the cloth's taut direction; exactly that of a unit of length if it is near one."""
    panel_scales: float
    """Largest over smallest scale of the panels."""
    taut: tuple[float, float]
    """5th and 95th percentile over the surface of the length in the taut direction, over its median."""
    across: float
    """Length across that direction over length along it, median."""
    sharp_share: float
    """Corners of the charts' outlines that turn sharply."""

    def faults(self) -> tuple[str, ...]:
        """Why the UVs are no pattern, one phrase each; empty if they are one."""
        low, high = self.taut
        found = []
        if self.panel_scales > PANEL_SCALES:
            found.append(f"charts of different scales, up to a factor of {self.panel_scales:.2f}")
        uneven = low < TAUT[0] or high > TAUT[1]
        if uneven or (self.across > CONFORMAL_ACROSS and high / low > CONFORMAL_SPREAD):
            found.append(f"lengths that differ from the mesh's by {100 * (low - 1):+.0f} to {100 * (high - 1):+.0f} %")
        if self.across < LEAST_ACROSS:
            found.append(f"squeezed one way to {100 * self.across:.0f} %")
        if self.sharp_share > SHARP_SHARE:
            found.append("jagged outlines")
        return tuple(found)


def fit_pattern(mesh: Mesh) -> PatternFit | None:
    """Compare UVs with the mesh they are on: that of a worn garment, with folds no larger than those of a drape.

    For every face, the map from the UVs to space stretches one direction most, the taut one. The idea is ours.

    Args:
        mesh: metres, with UVs.
    Returns:
        None where no face has any area on the UVs.
    """
    assert mesh.uv is not None
    uv, corners = mesh.uv.astype(np.float64), mesh.vertices.astype(np.float64)[mesh.faces]
    areas = face_areas(mesh.vertices.astype(np.float64), mesh.faces)
    doubled = _signed_areas(uv)
    spread = (np.abs(doubled) > 1e-9 * np.abs(doubled).max(initial=0.0)) & (areas > 1e-9 * areas.max(initial=0.0))
    if not spread.any():
        return None
    on_uv = np.stack([uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]], axis=2)[spread]
    in_space = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=2)[spread]
    along, across = np.linalg.svd(in_space @ np.linalg.inv(on_uv), compute_uv=False).T
    weight = areas[spread]
    median, low, high = (_weighted_percentile(along, weight, percent) for percent in (50, 5, 95))
    island = TangentLayout(mesh.faces, mesh.uv).islands()[spread]
    shares = np.bincount(island, weight) / weight.sum()
    panels = [island == index for index in np.flatnonzero(shares >= PANEL_SHARE)]
    scales = [_weighted_percentile(along[panel], weight[panel], 50) for panel in panels] or [median]
    return PatternFit(
        metres=next((unit for unit in METRES.values() if abs(median / unit - 1) < UNIT_TOLERANCE), median),
        panel_scales=max(scales) / min(scales),
        taut=(low / median, high / median),
        across=_weighted_percentile(across / along, weight, 50),
        sharp_share=_sharp_share(mesh.faces, mesh.uv),
    )


def with_known_pattern(garment: Garment) -> Garment:
    """The garment, with an answer to whether its UVs are its sewing pattern, if it had none; judged by its template."""
    if garment.pattern_metres is not None:
        return garment
    fit = None if garment.template.uv is None else fit_pattern(garment.template)
    return replace(garment, pattern_metres=0.0 if fit is None or fit.faults() else fit.metres)


def rest_lengths(garment: Garment, edges: Int32[np.ndarray, "edges 2"]) -> Float64[np.ndarray, " edges"]:
    """Lengths that the cloth wants: on the sewing pattern where the UVs are one, else on the template.

    A draped template is stretched here and folded there; the pattern is not. Charts that were cut out of the template
    know no more than it does, and a few per cent less: such lengths push the cloth about by millimetres
    (`python -m benchmarks own_template`). On a seam both panels are averaged.

    Args:
        garment: one that says whether its UVs are its pattern.
    """
    vertices, faces, uv = garment.template.vertices.astype(np.float64), garment.template.faces, garment.template.uv
    if uv is None or not garment.pattern_metres:
        return edge_lengths(vertices, edges)
    return garment.pattern_metres * flat_edge_lengths(uv, faces, edges)


def as_pattern(mesh: Mesh) -> float:
    """Metres in a unit of UVs of which somebody says that they are the pattern.

    Raises:
        InputError: there are none, or their panels are of different scales.
    """
    fit = None if mesh.uv is None else fit_pattern(mesh)
    if fit is None:
        raise InputError("expected UVs that are a sewing pattern, found none")
    if fit.panel_scales > TOLD_SCALES:
        raise InputError(
            f"expected a sewing pattern with all panels at one scale, found scales that differ by a factor of "
            f"{fit.panel_scales:.2f}"
        )
    return fit.metres


def picture_span(garment: Garment) -> tuple[Float64[np.ndarray, " 2"], Float64[np.ndarray, " 2"]]:
    """The rectangle of UVs that a picture of the garment shows, its corners of least and largest u and v: 0 to 1, as
    textures lie; the bounding box of UVs that are a pattern in metres, or reach beyond.

    Raises:
        InputError: the template has no UVs.
    """
    uv = garment.template.uv
    if uv is None:
        raise InputError("template: expected UVs under its picture, found none")
    low, high = uv.reshape(-1, 2).min(axis=0).astype(np.float64), uv.reshape(-1, 2).max(axis=0).astype(np.float64)
    if with_known_pattern(garment).pattern_metres != 1 and low.min() >= 0 and high.max() <= 1:
        return np.zeros(2), np.ones(2)
    return low, high


def picture_uv(garment: Garment) -> Float32[np.ndarray, "faces 3 2"]:
    """UVs such that the picture of `picture_span` fills the unit square.

    Raises:
        InputError: the template has no UVs, or such as have no area.
    """
    low, high = picture_span(garment)
    if not (high > low).all():
        raise InputError("template: expected UVs that spread the surface out, found none with any area")
    assert garment.template.uv is not None
    return np.clip((garment.template.uv.astype(np.float64) - low) / (high - low), 0, 1).astype(np.float32)


def _weighted_percentile(values: np.ndarray, weights: np.ndarray, percent: float) -> float:
    order = np.argsort(values, kind="stable")
    reached = np.searchsorted(np.cumsum(weights[order]), percent / 100 * weights.sum())
    return float(values[order[min(int(reached), len(values) - 1)]])


def _sharp_share(faces: Int32[np.ndarray, "faces 3"], uv: Float32[np.ndarray, "faces 3 2"]) -> float:
    """Share of the corners along the charts' outlines that turn by more than `SHARP_DEG`."""
    corner = uv_corners(faces, uv)
    places = np.empty((int(corner.max(initial=-1)) + 1, 2))
    places[corner.reshape(-1)] = uv.reshape(-1, 2)
    sides = half_edges(corner)
    count = len(places)
    keys, back = sides[:, 0].astype(np.int64) * count + sides[:, 1], sides[:, 1].astype(np.int64) * count + sides[:, 0]
    outline = sides[~np.isin(keys, back)]
    outline = outline[np.argsort(outline[:, 0], kind="stable")]
    first = np.searchsorted(outline[:, 0], outline[:, 1])
    single = np.searchsorted(outline[:, 0], outline[:, 1], side="right") - first == 1
    onward = outline[first[single]]
    here, there = (places[side[:, 1]] - places[side[:, 0]] for side in (outline[single], onward))
    turn = np.arctan2(here[:, 0] * there[:, 1] - here[:, 1] * there[:, 0], (here * there).sum(axis=1))
    return float((np.abs(turn) > np.radians(SHARP_DEG)).mean()) if len(turn) else 0.0


def _signed_areas(uv: np.ndarray) -> np.ndarray:
    """Twice the area of each triangle (F, 3, 2), positive where counter-clockwise."""
    along, across = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    return along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]
