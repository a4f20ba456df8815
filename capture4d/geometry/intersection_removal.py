"""Taking a garment out of the body it is on, without tearing it: depth and edge lengths as one system.

Every vertex leaves the limb that carries it, not the one that it happens to be nearest to: where an arm hangs beside
the trunk, neighbours would otherwise leave on different sides. What a vertex may do is a `Contacts`: it stays above the
surface of its own limb, and below that of any other limb that it sees from there. Edges are no longer than `longest`,
and no shorter than `shortest`. All of these are projections of positions, taken in turn (Gauss-Seidel), with a little
diffusion of the displacement between, which spreads a push over the cloth around; where the limbs are is looked up anew
every few sweeps. What is left at the end is moved straight out, and measured by a search of its own.

Letters: V vertices, F faces, E edges.

References: Müller et al., Position Based Dynamics (2007); Bouaziz et al., Projective Dynamics (SIGGRAPH 2014) for
constraints as projections. TailorNet's published least squares (CVPR 2020), which this replaces, knows no edges.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Float64, Int32

from capture4d.geometry.mesh import doubled_area_vectors, edge_lengths, unique_edges, vertex_adjacency
from capture4d.heavy_imports import njit

__all__ = ["Contacts", "IntersectionRemoval", "Penetration", "RemovalSettings", "Removed", "Surroundings", "project"]

EDGE_MIDDLES = np.array([[1, 1, 0], [0, 1, 1], [1, 0, 1], [2 / 3, 2 / 3, 2 / 3]]) / 2
"""Where a face is probed: the middles of its edges, and its own."""
THINNEST_M, SLACK_M = 0.03, 0.001
"""A limb of this radius bulges through a face by its longest edge squared over eight radii, and some slack. Deeper, the
face spans a crease, of an arm against the trunk, and lifting its corners would blow it up."""
NOISE_M = 1e-4
"""Depth that single precision and the facets of a body make; less is not inside."""
SHORTEST = 0.5
"""Of an edge's rest length: cloth that is pressed together folds, but its triangles do not vanish."""
STILL_M = 2e-5
"""Nothing has moved farther than this since the last search: it has settled."""


@runtime_checkable
class RemovalSettings(Protocol):
    """What a stage's own settings have to say."""

    @property
    def enabled(self) -> bool:
        """Off, nothing is taken out, and what is inside is only measured; edges keep to their lengths."""
        ...

    @property
    def margin_mm(self) -> float:
        """How far outside vertices are put."""
        ...

    @property
    def rounds(self) -> int:
        """Searches for where the limbs are."""
        ...

    @property
    def sweeps(self) -> int:
        """Passes over all edges and vertices from one search to the next."""
        ...

    @property
    def spread(self) -> float:
        """Share of the way to its neighbours' mean displacement that a vertex goes in a sweep, at first; none in the
        last."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Contacts:
    """Where points are between the limbs of a body."""

    heights: Float64[np.ndarray, " points"]
    """Over the limb that carries each point, metres; negative inside."""
    normals: Float64[np.ndarray, "points 3"]
    """Of that limb, outwards, at the nearest point."""
    feet: Float64[np.ndarray, "points 3"]
    """That nearest point."""
    outwards: Float64[np.ndarray, "points 3"]
    """Direction from the foot to the point; of a point inside, the normal."""
    room: Float64[np.ndarray, " points"]
    """How far it is from the foot, that way, to another limb; infinite where there is none."""
    overlapping: Bool[np.ndarray, " points"]
    """Whether the foot is itself inside another limb: the body overlaps itself there."""

    @property
    def depths(self) -> Float64[np.ndarray, " points"]:
        """How deep each point is in its own limb or, where the body does not overlap itself, in another; 0 outside."""
        other = np.where(self.overlapping, -np.inf, self.heights - self.room)
        return np.maximum(np.maximum(-self.heights, other), 0.0)


@runtime_checkable
class Surroundings(Protocol):
    """A posed body, as one garment sees it."""

    def contacts(self, points: Float[np.ndarray, "verts 3"]) -> Contacts:
        """Of the garment's vertices, wherever they are by now."""
        ...

    def heights(
        self, points: Float[np.ndarray, "points 3"], vertices: Int32[np.ndarray, " points"]
    ) -> Float64[np.ndarray, " points"]:
        """Heights of other points of the garment, each over the limb that carries a vertex beside it."""
        ...


@dataclass(frozen=True, slots=True)
class Penetration:
    """How much of the garment is inside the body."""

    inside_percent: float
    """Vertices behind the surface of the limb that carries them, or behind another's where limbs do not overlap."""
    depth_max_mm: float
    """Of the deepest; 0 if there are none."""
    overlap_percent: float
    """Vertices over skin that lies inside another limb: there is no outside for them between the two."""

    @staticmethod
    def of(contacts: Contacts) -> Penetration:
        depths = contacts.depths
        count = max(len(depths), 1)
        inside = depths > NOISE_M
        return Penetration(
            100.0 * float(inside.sum()) / count,
            1e3 * float(depths[inside].max(initial=0.0)),
            100.0 * float(contacts.overlapping.sum()) / count,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Removed:
    """A garment outside the body."""

    vertices: Float64[np.ndarray, "verts 3"]
    before: Penetration
    after: Penetration
    moved_m: Float64[np.ndarray, " verts"]
    was_inside: Bool[np.ndarray, " verts"]
    flipped: Bool[np.ndarray, " faces"]
    """Faces turned against the body: against their limb's normals at all three corners, where limbs do not overlap."""

    @property
    def rest_moved_mm(self) -> float:
        """Mean displacement of the vertices that were outside."""
        kept = self.moved_m[~self.was_inside]
        return 1e3 * float(kept.mean()) if len(kept) else 0.0


class IntersectionRemoval:
    """One garment with what its frames share; one call a frame.

    Args:
        rest_m: lengths of its edges at rest on the person who wears it, as `unique_edges` orders them, metres.
        longest: times that, the longest an edge may be; infinite for edges of any length.
    """

    def __init__(
        self,
        faces: Int32[np.ndarray, "faces 3"],
        count: int,
        rest_m: Float64[np.ndarray, " edges"],
        longest: Float64[np.ndarray, " edges"] | float,
        config: RemovalSettings,
    ) -> None:
        self._faces, self._config = faces, config
        self._edges, self._rest = unique_edges(faces), np.maximum(rest_m, 1e-9)
        self._longest = longest * self._rest
        adjacency = vertex_adjacency(faces, count)
        self._offsets, self._around = adjacency.indptr.astype(np.int64), adjacency.indices.astype(np.int32)

    def __call__(self, vertices: Float[np.ndarray, "verts 3"], body: Surroundings) -> Removed:
        """Move a garment, metres, out of a body; and draw its edges together."""
        start = np.ascontiguousarray(vertices, np.float64)
        found = body.contacts(start)
        before, was_inside = Penetration.of(found), found.depths > NOISE_M
        result = self._settled(start, found, body)
        last = body.contacts(result)
        if self._config.enabled and (last.heights < 0).any():
            out = np.maximum(-last.heights, 0.0)
            result = result + (out + NOISE_M * (out > 0))[:, None] * last.normals
            last = body.contacts(result)
        outwards = doubled_area_vectors(result, self._faces)
        flipped = (np.einsum("fx,fcx->fc", outwards, last.normals[self._faces]) < 0).all(axis=1)
        flipped &= ~last.overlapping[self._faces].any(axis=1)
        moved = np.linalg.norm(result - start, axis=1)
        return Removed(result, before, Penetration.of(last), moved, was_inside, flipped)

    def _settled(self, start: np.ndarray, found: Contacts, body: Surroundings) -> np.ndarray:
        """Projections in turn, until nothing moves or the rounds are over."""
        config, margin = self._config, 1e-3 * self._config.margin_mm
        points, lengths = start.copy(), edge_lengths(start, self._edges)
        shortest = np.minimum(SHORTEST * self._rest, lengths)
        sides = np.linalg.norm(start[np.roll(self._faces, -1, axis=1)] - start[self._faces], axis=2)
        bulges = SLACK_M + sides.max(axis=1, initial=0.0) ** 2 / (8 * THINNEST_M)
        lifted = np.zeros(len(start))
        for turn in range(config.rounds):
            if config.enabled:
                lifted = np.maximum(lifted, self._lifts(points, found, body, bulges, margin))
                low, high = _bounds(points, found, margin, lifted)
            else:
                low, high = np.full(len(start), -np.inf), np.full(len(start), np.inf)
            was, spread = points.copy(), config.spread * (1 - (turn + 1) / config.rounds)
            project(
                points, start, self._edges, self._longest, shortest, self._offsets, self._around,
                found.feet, found.normals, found.outwards, low, high, spread, config.sweeps,
            )  # fmt: skip
            if np.abs(points - was).max(initial=0.0) < STILL_M:
                break
            found = body.contacts(points)
        return points

    def _lifts(
        self, points: np.ndarray, found: Contacts, body: Surroundings, bulges: np.ndarray, margin: float
    ) -> np.ndarray:
        """Heights (V,) that corners need where the body pokes through their face, by less than its bulge (F,)."""
        lifts = np.zeros(len(points))
        lowest = found.heights[self._faces].min(axis=1)
        near = np.flatnonzero((lowest >= 0) & (lowest < bulges))
        if not len(near):
            return lifts
        corners = self._faces[near]
        probes = np.einsum("pk,fkx->fpx", EDGE_MIDDLES, points[corners]).reshape(-1, 3)
        beside = np.repeat(corners[:, 0], len(EDGE_MIDDLES))
        deepest = body.heights(probes, beside).reshape(len(near), -1).min(axis=1)
        through = (deepest < 0) & (deepest > -bulges[near])
        wanted = np.minimum(found.heights[corners[through]] + (margin - deepest[through])[:, None],
                            margin + bulges[near[through], None])  # fmt: skip
        np.maximum.at(lifts, corners[through], wanted)
        return lifts


def _bounds(points: np.ndarray, found: Contacts, margin: float, lifted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest height of each vertex over the limb that carries it.

    What is outside may come no nearer, up to the margin; what is inside is put there. Between two limbs that are closer
    than two margins it goes to the middle. Where the limbs overlap, the other one is let through.
    """
    present = np.einsum("vx,vx->v", points - found.feet, found.normals)  # as `project` measures it
    low = np.where(found.heights < 0, margin, np.minimum(present, margin))
    half = found.room / 2
    high = np.where(found.overlapping, np.inf, np.maximum(found.room - margin, half))
    return np.minimum(np.maximum(low, lifted), half), high


@njit(cache=True)
def project(
    points, start, edges, longest, shortest, offsets, around, feet, normals, outwards, low, high, spread, sweeps
):
    """Move `points` in place: edges first, then each vertex with its neighbours and between its bounds."""
    for _ in range(sweeps):
        for e in range(len(edges)):
            i, j = edges[e, 0], edges[e, 1]
            dx, dy, dz = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1], points[i, 2] - points[j, 2]
            length = np.sqrt(dx * dx + dy * dy + dz * dz)
            if shortest[e] <= length <= longest[e]:
                continue
            share = 0.5 * (min(max(length, shortest[e]), longest[e]) - length) / max(length, 1e-12)
            points[i, 0] += share * dx
            points[i, 1] += share * dy
            points[i, 2] += share * dz
            points[j, 0] -= share * dx
            points[j, 1] -= share * dy
            points[j, 2] -= share * dz
        for v in range(len(points)):
            degree = offsets[v + 1] - offsets[v]
            if degree > 0:
                for k in range(3):
                    total = 0.0
                    for entry in range(offsets[v], offsets[v + 1]):
                        total += points[around[entry], k] - start[around[entry], k]
                    points[v, k] += spread * (total / degree - points[v, k] + start[v, k])
            height, away = 0.0, 0.0
            for k in range(3):
                height += normals[v, k] * (points[v, k] - feet[v, k])
                away += outwards[v, k] * (points[v, k] - feet[v, k])
            if height < low[v]:
                for k in range(3):
                    points[v, k] += (low[v] - height) * normals[v, k]
            elif away > high[v]:
                for k in range(3):
                    points[v, k] += (high[v] - away) * outwards[v, k]
