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
from jaxtyping import Bool, Float, Float64, Int32, Int64

from capture4d.geometry.mesh import edge_lengths, unique_edges, vertex_adjacency
from capture4d.geometry.triangles import along3, cross3, dot3, row3
from capture4d.heavy_imports import njit

__all__ = [
    "Contacts",
    "IntersectionRemoval",
    "Penetration",
    "RemovalSettings",
    "Removed",
    "Surroundings",
    "project",
    "sweep_order",
]

EDGE_MIDDLES = np.array([[1, 1, 0], [0, 1, 1], [1, 0, 1], [2 / 3, 2 / 3, 2 / 3]]) / 2
"""Where a face is probed: the middles of its edges, and its own."""
THINNEST_M, SLACK_M = 0.03, 0.001
"""A limb of this radius bulges through a face by its longest edge squared over eight radii, and some slack. Deeper, the
face spans a crease, of an arm against the trunk, and lifting its corners would blow it up."""
NOISE_M = 1e-4
"""Depth that single precision and the facets of a body make; less is not inside."""
SHORTEST = 0.5
"""Of an edge's rest length: cloth that is pressed together folds, but its triangles do not vanish."""
ROUNDING_M = 1e-9
"""By which what edges and vertices have left of their bounds is told shorter than it is."""
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
        self,
        points: Float[np.ndarray, "points 3"],
        vertices: Int32[np.ndarray, " points"],
        numbers: Int64[np.ndarray, " points"],
    ) -> Float64[np.ndarray, " points"]:
        """Heights of other points of the garment, each over the limb that carries a vertex beside it.

        Args:
            numbers: of the points, the same from search to search, so that each is known again.
        """
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
        self._order = sweep_order(self._offsets, self._around)

    def __call__(self, vertices: Float[np.ndarray, "verts 3"], body: Surroundings) -> Removed:
        """Move a garment, metres, out of a body; and draw its edges together."""
        start = np.ascontiguousarray(vertices, np.float64)
        found = body.contacts(start)
        before, was_inside = Penetration.of(found), found.depths > NOISE_M
        result, last = self._settled(start, found, body)
        if self._config.enabled and (last.heights < 0).any():
            out = np.maximum(-last.heights, 0.0)
            result = result + (out + NOISE_M * (out > 0))[:, None] * last.normals
            last = body.contacts(result)
        flipped = _turned(result, self._faces, last.normals, last.overlapping)
        moved = np.linalg.norm(result - start, axis=1)
        return Removed(result, before, Penetration.of(last), moved, was_inside, flipped)

    def _settled(self, start: np.ndarray, found: Contacts, body: Surroundings) -> tuple[np.ndarray, Contacts]:
        """Projections in turn, until nothing moves or the rounds are over; and where the result is."""
        config, margin = self._config, 1e-3 * self._config.margin_mm
        points, lengths = start.copy(), edge_lengths(start, self._edges)
        shortest = np.minimum(SHORTEST * self._rest, lengths)
        bulges = SLACK_M + _longest_sides(start, self._faces) ** 2 / (8 * THINNEST_M)
        lifted, due, travelled = np.zeros(len(start)), np.full(len(lengths), -1.0), np.zeros(len(start))
        for turn in range(config.rounds):
            if config.enabled:
                lifted = np.maximum(lifted, self._lifts(points, found, body, bulges, margin))
                low, high = _bounds(
                    points, found.feet, found.normals, found.heights, found.room, found.overlapping, margin, lifted
                )
            else:
                low, high = np.full(len(start), -np.inf), np.full(len(start), np.inf)
            was, spread = points.copy(), config.spread * (1 - (turn + 1) / config.rounds)
            project(
                points, start, self._edges, self._longest, shortest, due, travelled,
                self._offsets, self._around, self._order, found.feet, found.normals, found.outwards, low, high,
                spread, config.sweeps,
            )  # fmt: skip
            found = body.contacts(points)
            if np.abs(points - was).max(initial=0.0) < STILL_M:
                break
        return points, found

    def _lifts(
        self, points: np.ndarray, found: Contacts, body: Surroundings, bulges: np.ndarray, margin: float
    ) -> np.ndarray:
        """Heights (V,) that corners need where the body pokes through their face, by less than its bulge (F,)."""
        lifts = np.zeros(len(points))
        near, probes = _probes(points, self._faces, found.heights, bulges, EDGE_MIDDLES)
        if not len(near):
            return lifts
        corners = self._faces[near]
        beside = np.repeat(corners[:, 0], len(EDGE_MIDDLES))
        numbers = (len(EDGE_MIDDLES) * near[:, None] + np.arange(len(EDGE_MIDDLES))).reshape(-1)
        deepest = _least(body.heights(probes, beside, numbers).reshape(len(near), -1))
        through = (deepest < 0) & (deepest > -bulges[near])
        wanted = np.minimum(found.heights[corners[through]] + (margin - deepest[through])[:, None],
                            margin + bulges[near[through], None])  # fmt: skip
        np.maximum.at(lifts, corners[through], wanted)
        return lifts


def _least(rows: np.ndarray) -> np.ndarray:
    """Of each row; column by column, which is faster by far where rows are short."""
    least = rows[:, 0]
    for column in range(1, rows.shape[1]):
        least = np.minimum(least, rows[:, column])
    return least


def sweep_order(
    offsets: Int64[np.ndarray, " verts_plus_1"], around: Int32[np.ndarray, " entries"]
) -> Int64[np.ndarray, " verts"]:
    """An order of the vertices whose sweep gives what the ascending order gives, to the bit: neighbours keep theirs.

    In between come vertices that do not wait for each other, so that the processor can be at several at a time; in the
    ascending order most vertices are neighbours of the one before.
    """
    return np.argsort(_turns(offsets, around), kind="stable")


@njit(cache=True)
def _turns(offsets, around):
    """Of each vertex, one more than the greatest of its neighbours that come before it."""
    turns = np.zeros(len(offsets) - 1, np.int64)
    for v in range(len(turns)):
        for entry in range(offsets[v], offsets[v + 1]):
            if around[entry] < v:
                turns[v] = max(turns[v], turns[around[entry]] + 1)
    return turns


@njit(cache=True)
def _longest_sides(points, faces):
    """Of each face, metres."""
    longest = np.zeros(len(faces))
    for f in range(len(faces)):
        a, b, c = row3(points, faces[f, 0]), row3(points, faces[f, 1]), row3(points, faces[f, 2])
        for along in (along3(b, 1.0, a, -1.0), along3(c, 1.0, b, -1.0), along3(a, 1.0, c, -1.0)):
            longest[f] = max(longest[f], np.sqrt(dot3(along, along)))
    return longest


@njit(cache=True)
def _turned(points, faces, normals, overlapping):
    """Faces against the body's normals at all three corners, none of which is where limbs overlap."""
    turned = np.zeros(len(faces), np.bool_)
    for f in range(len(faces)):
        a, b, c = row3(points, faces[f, 0]), row3(points, faces[f, 1]), row3(points, faces[f, 2])
        out = cross3(along3(b, 1.0, a, -1.0), along3(c, 1.0, a, -1.0))
        against = True
        for corner in range(3):
            v = faces[f, corner]
            over = out[0] * normals[v, 0] + out[2] * normals[v, 2] + out[1] * normals[v, 1]
            against = against and not overlapping[v] and over < 0
        turned[f] = against
    return turned


@njit(cache=True)
def _probes(points, faces, heights, bulges, middles):
    """Faces whose lowest corner is outside by less than their bulge, and points on them to look at, face by face."""
    near, probes = np.empty(len(faces), np.int64), np.empty((len(faces) * len(middles), 3))
    count = 0
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        lowest = min(heights[a], heights[b], heights[c])
        if not 0 <= lowest < bulges[f]:
            continue
        for m in range(len(middles)):
            u, v, w = middles[m, 0], middles[m, 1], middles[m, 2]
            for k in range(3):
                probes[count * len(middles) + m, k] = u * points[a, k] + v * points[b, k] + w * points[c, k]
        near[count] = f
        count += 1
    return near[:count], probes[: count * len(middles)]


@njit(cache=True)
def _bounds(points, feet, normals, heights, room, overlapping, margin, lifted):
    """Least and greatest height of each vertex over the limb that carries it.

    What is outside may come no nearer, up to the margin; what is inside is put there. Between two limbs that are closer
    than two margins it goes to the middle. Where the limbs overlap, the other one is let through.
    """
    lows, highs = np.empty(len(points)), np.empty(len(points))
    for v in range(len(points)):
        x, y, z = points[v, 0] - feet[v, 0], points[v, 1] - feet[v, 1], points[v, 2] - feet[v, 2]
        present = x * normals[v, 0] + z * normals[v, 2] + y * normals[v, 1]
        low, half = margin if heights[v] < 0 else min(present, margin), room[v] / 2
        lows[v] = min(max(low, lifted[v]), half)
        highs[v] = np.inf if overlapping[v] else max(room[v] - margin, half)
    return lows, highs


@njit(cache=True)
def project(
    points, start, edges, longest, shortest, due, travelled, offsets, around, order,
    feet, normals, outwards, low, high, spread, sweeps,
):  # fmt: skip
    """Move `points` in place: edges first, then each vertex with its neighbours and between its bounds.

    An edge that is well within its lengths is looked at again when its ends have travelled far enough to change that,
    and so is a vertex between its bounds. Indices without a sign are spared a test each.

    Args:
        due: of each edge, how far its ends have to travel, together, before it is looked at; at first -1.
        travelled: by each vertex, metres; at first 0. Both are kept from call to call of a frame.
        order: of the vertices, `sweep_order`.
    """
    moved, clear = points - start, np.full(len(points), -1.0)
    for _ in range(sweeps):
        for e in range(len(edges)):
            i, j = np.uint32(edges[e, 0]), np.uint32(edges[e, 1])
            way = travelled[i] + travelled[j]
            if way < due[e]:
                continue
            dx, dy, dz = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1], points[i, 2] - points[j, 2]
            length = np.sqrt(dx * dx + dy * dy + dz * dz)
            if shortest[e] <= length <= longest[e]:
                due[e] = way + min(length - shortest[e], longest[e] - length) - ROUNDING_M
                continue
            share = 0.5 * (min(max(length, shortest[e]), longest[e]) - length) / max(length, 1e-12)
            dx, dy, dz = share * dx, share * dy, share * dz
            points[i, 0] += dx
            points[i, 1] += dy
            points[i, 2] += dz
            points[j, 0] -= dx
            points[j, 1] -= dy
            points[j, 2] -= dz
            for k in range(3):
                moved[i, k], moved[j, k] = points[i, k] - start[i, k], points[j, k] - start[j, k]
            way = abs(dx) + abs(dy) + abs(dz)
            travelled[i] += way
            travelled[j] += way
        for turn in range(len(order)):
            v = np.uint64(order[turn])
            first, end = offsets[v], offsets[v + np.uint64(1)]
            degree = end - first
            if spread != 0.0 and degree > 0:
                tx, ty, tz = 0.0, 0.0, 0.0
                for entry in range(first, end):
                    n = np.uint32(around[entry])
                    tx += moved[n, 0]
                    ty += moved[n, 1]
                    tz += moved[n, 2]
                dx = spread * (tx / degree - points[v, 0] + start[v, 0])
                dy = spread * (ty / degree - points[v, 1] + start[v, 1])
                dz = spread * (tz / degree - points[v, 2] + start[v, 2])
                x, y, z = points[v, 0] + dx, points[v, 1] + dy, points[v, 2] + dz
                points[v, 0], points[v, 1], points[v, 2] = x, y, z
                moved[v, 0], moved[v, 1], moved[v, 2] = x - start[v, 0], y - start[v, 1], z - start[v, 2]
                travelled[v] += abs(dx) + abs(dy) + abs(dz)
            if travelled[v] < clear[v]:
                continue
            x, y, z = points[v, 0] - feet[v, 0], points[v, 1] - feet[v, 1], points[v, 2] - feet[v, 2]
            height = normals[v, 0] * x + normals[v, 1] * y + normals[v, 2] * z
            away = outwards[v, 0] * x + outwards[v, 1] * y + outwards[v, 2] * z
            if height < low[v]:
                way = low[v] - height
                dx, dy, dz = way * normals[v, 0], way * normals[v, 1], way * normals[v, 2]
            elif away > high[v]:
                way = high[v] - away
                dx, dy, dz = way * outwards[v, 0], way * outwards[v, 1], way * outwards[v, 2]
            else:
                clear[v] = travelled[v] + min(height - low[v], high[v] - away) - ROUNDING_M
                continue
            x, y, z = points[v, 0] + dx, points[v, 1] + dy, points[v, 2] + dz
            points[v, 0], points[v, 1], points[v, 2] = x, y, z
            moved[v, 0], moved[v, 1], moved[v, 2] = x - start[v, 0], y - start[v, 1], z - start[v, 2]
            travelled[v] += abs(dx) + abs(dy) + abs(dz)
