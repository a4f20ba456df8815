"""Walks over a body's faces to the point of a limb that is nearest; and the same again from nearby, without walking.

A walk looks at the faces around the corners of the face where it is, goes to the nearest of them, and ends where none
is nearer. What it finds depends on the faces that it has passed, not on distances alone, so a point that has moved a
little is not simply looked up among the faces nearby: the walk is repeated, less all that cannot have changed. A
distance to a face changes by no more than the point has moved. So a face that was farther than the nearest one of its
round by over twice that is farther still, and need not be looked at; mostly one or two faces are left. Where a round
ends at another face than before, the whole walk is done. The result is the same to the bit.

Rounds that cannot end elsewhere are not remembered. After a larger move what was looked at is remembered anew, of the
rest how much nearer it may have come, and only as much as counts for moves of that size: from search to search cloth
moves less.

Compiled loops: plain arrays in, plain arrays out; nothing is checked. Rounds are what lies around one face.

Letters: P points, F faces.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64, Int32

from capture4d.geometry.triangles import along3, closest_in_triangle, cross3, dot3, row3
from capture4d.heavy_imports import njit

__all__ = ["Walks", "face_rows", "walk", "walk_again"]

CAPACITY = 32
"""Faces of a walk that are remembered, with a place for each round; of a longer walk nothing is."""
REMEMBERED_M = 0.003
"""Faces farther than the nearest of their round by more are not remembered: a point may move by half as much."""
RENEWED_M = 0.0001
"""Twice the move after which a walk is remembered anew: after any where that makes it shorter, ..."""
LONG = 6
"""... as where it has more faces and rounds than this; ..."""
SHRINKING = 8.0
"""... and as far as a move of so many times that, or this, can need."""
ROUNDING_M = 1e-6
"""By which distances of the same face may differ beyond the move; also makes good for `NEARER_M2`."""
NEARER_M2 = 1e-14
"""A face is nearer if the square of its distance is less by this: no walk goes to and fro between equals."""
NEEDLE_M = 1e-5
"""Height of a triangle below which the nearest point in it is known to less than `ROUNDING_M`."""
PASSED = 512
"""Faces of a walk that are looked at before they are chosen from."""


class Walks:
    """What the walks of P points have passed; filled by `walk_again`.

    Args:
        count: of the points.
        faces: of the body.
    """

    def __init__(self, count: int, faces: int) -> None:
        self.starts: Int32[np.ndarray, " points"] = np.full(count, -1, np.int32)
        """Where each walk began; -1 where nothing is remembered."""
        self.origins: Float64[np.ndarray, "points 3"] = np.empty((count, 3))
        """Where each point was."""
        self.ends: Int32[np.ndarray, " points"] = np.empty(count, np.int32)
        """The face where each walk ended."""
        self.reaches: Float32[np.ndarray, " points"] = np.empty(count, np.float32)
        """Twice the move up to which nothing matters that is not remembered, metres."""
        self.clear: Float32[np.ndarray, " points"] = np.empty(count, np.float32)
        """As far from any other way as twice this: within it a walk ends at the same face for sure, metres."""
        self.lengths: Int32[np.ndarray, " points"] = np.empty(count, np.int32)
        self.passed: Int32[np.ndarray, "points capacity"] = np.empty((count, CAPACITY), np.int32)
        """Faces in the order of the walk. A round begins with the face where it ends, as -1 - face."""
        self.gaps: Float32[np.ndarray, "points capacity"] = np.empty((count, CAPACITY), np.float32)
        """How much farther than the nearest face of its round each was at least; where a round begins, that of the one
        before; metres."""
        self.seen: Int32[np.ndarray, " faces"] = np.zeros(faces, np.int32)
        """The number of the last walk that has seen a face."""
        self.walked: Int32[np.ndarray, "1"] = np.zeros(1, np.int32)
        """How many walks there were."""

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """As `walk_again` wants them."""
        known = self.starts, self.origins, self.ends, self.reaches, self.clear, self.lengths, self.passed, self.gaps
        return *known, self.seen, self.walked


@njit(cache=True)
def face_rows(vertices, normals, faces):
    """All that is asked of a face in a row, (F, 18): positions and normals of its corners; and which faces are too thin
    for their nearest points to be exact."""
    rows, needles = np.empty((len(faces), 18)), np.zeros(len(faces), np.bool_)
    for f in range(len(faces)):
        for corner in range(3):
            v = faces[f, corner]
            for k in range(3):
                rows[f, 3 * corner + k], rows[f, 9 + 3 * corner + k] = vertices[v, k], normals[v, k]
        a, b, c = row3(vertices, faces[f, 0]), row3(vertices, faces[f, 1]), row3(vertices, faces[f, 2])
        u, v, w = along3(b, 1.0, a, -1.0), along3(c, 1.0, a, -1.0), along3(c, 1.0, b, -1.0)
        normal, longest = cross3(u, v), max(dot3(u, u), dot3(v, v), dot3(w, w))
        needles[f] = not dot3(normal, normal) > NEEDLE_M**2 * longest
    return rows, needles


@njit(cache=True)
def walk(points, starts, rows, faces, offsets, fans):
    """For each point a face from which no face around is nearer, and barycentrics of the nearest point in it.

    Nothing is left out: this is what `walk_again` is measured by.
    """
    found, weights = starts.copy(), np.zeros((len(points), 3))
    for i in range(len(points)):
        p = row3(points, i)
        face, best, nearer = starts[i], np.inf, True
        while nearer:
            around, nearer = face, False
            for corner in range(3):
                vertex = faces[around, corner]
                for entry in range(offsets[vertex], offsets[vertex + 1]):
                    f = fans[entry]
                    distance, u, v, w = _to_face(p, rows, f)
                    if distance < best - NEARER_M2:
                        best, face, nearer = distance, f, True
                        weights[i, 0], weights[i, 1], weights[i, 2] = u, v, w
        found[i] = face
    return found, weights


@njit(cache=True)
def walk_again(
    points, numbers, starts, rows, needles, faces, offsets, fans,
    known_starts, origins, known_ends, reaches, clear, lengths, passed, gaps, seen, walked,
):  # fmt: skip
    """What `walk` finds, of points that are known by their numbers, from what was remembered of them.

    Args:
        numbers: rows of the `Walks`, whose arrays the last ones are.
        rows, needles: `face_rows`.
    Returns:
        Heights over the nearest points, unit normals there, these points, and their faces.
    """
    found, heights = starts.copy(), np.empty(len(points))
    directions, feet = np.empty((len(points), 3)), np.empty((len(points), 3))
    tested, squares = np.empty(PASSED, np.int32), np.empty(PASSED)
    ends, winners, bests = np.empty(PASSED, np.int32), np.empty(PASSED, np.int32), np.empty(PASSED)
    for i in range(len(points)):
        p, row = row3(points, i), numbers[i]
        if known_starts[row] == starts[i]:
            moved = along3(p, 1.0, row3(origins, row), -1.0)
            slack = 2.0 * np.sqrt(dot3(moved, moved)) + ROUNDING_M
            face = -1
            u, v, w = 0.0, 0.0, 0.0
            if slack < clear[row]:
                face = known_ends[row]
                _, u, v, w = _to_face(p, rows, face)
            elif slack <= reaches[row]:
                face, u, v, w = _repeated(p, slack, row, lengths, passed, gaps, rows, squares, bests)
                if face >= 0 and (slack > RENEWED_M or lengths[row] > LONG):
                    reaches[row] = min(reaches[row] - slack, SHRINKING * max(slack, RENEWED_M))
                    clear[row] = _renewed(slack, reaches[row], row, lengths, passed, gaps, squares, bests)
                    origins[row, 0], origins[row, 1], origins[row, 2] = p
            if face >= 0:
                found[i] = face
                _stand(p, rows, face, u, v, w, i, heights, directions, feet)
                continue
        walked[0] += 1
        stamp, face, best, u, v, w = walked[0], starts[i], np.inf, 0.0, 0.0, 0.0
        count, rounds, nearer = 0, 0, True
        while nearer:
            around, nearer = face, False
            for corner in range(3):
                vertex = faces[around, corner]
                for entry in range(offsets[vertex], offsets[vertex + 1]):
                    f = fans[entry]
                    if seen[f] == stamp:
                        continue  # it was not nearer than what was nearest then, nor is it now
                    seen[f] = stamp
                    distance, first, second, third = _to_face(p, rows, f)
                    if count < PASSED:
                        tested[count], squares[count] = f, distance
                    count += 1
                    if distance < best - NEARER_M2:
                        best, face, nearer = distance, f, True
                        u, v, w = first, second, third
            if rounds < PASSED:
                ends[rounds], winners[rounds], bests[rounds] = count, face, best
            rounds += 1
        found[i] = face
        _stand(p, rows, face, u, v, w, i, heights, directions, feet)
        known_starts[row] = -1
        if max(count, rounds) <= PASSED:
            lengths[row], clear[row] = _remembered(
                tested, squares, ends, winners, bests, rounds, needles, row, passed, gaps
            )
            if lengths[row] > 0:
                known_starts[row], known_ends[row], reaches[row] = starts[i], face, REMEMBERED_M
                origins[row, 0], origins[row, 1], origins[row, 2] = p
    return heights, directions, feet, found


@njit(cache=True)
def _to_face(p, rows, f):
    """Square of a point's distance to a face, and barycentrics of the nearest point."""
    a = rows[f, 0], rows[f, 1], rows[f, 2]
    b = rows[f, 3], rows[f, 4], rows[f, 5]
    c = rows[f, 6], rows[f, 7], rows[f, 8]
    u, v, w = closest_in_triangle(p, a, b, c)
    x = p[0] - u * a[0] - v * b[0] - w * c[0]
    y = p[1] - u * a[1] - v * b[1] - w * c[1]
    z = p[2] - u * a[2] - v * b[2] - w * c[2]
    return x * x + y * y + z * z, u, v, w


@njit(cache=True)
def _remembered(tested, squares, ends, winners, bests, rounds, needles, row, passed, gaps):
    """Fill a row of `passed` and `gaps` with a walk.

    Returns:
        How many there are, 0 if too many or not exact; and how clear of any other way it is. The last round ends where
        the one before it did.
    """
    length, j, before, clear = 0, 0, np.inf, np.inf
    for r in range(rounds):
        nearest = np.sqrt(bests[r])
        if before - nearest > REMEMBERED_M:
            length = _without_certain(length, REMEMBERED_M, row, passed, gaps)
        if length == CAPACITY:
            return 0, 0.0
        passed[row, length], gaps[row, length] = -1 - winners[r], before - nearest
        if r < rounds - 1:
            clear = min(clear, before - nearest)
        length, before = length + 1, nearest
        farthest = (nearest + REMEMBERED_M) ** 2
        while j < ends[r]:
            if needles[tested[j]]:
                return 0, 0.0
            if squares[j] <= farthest:
                if length == CAPACITY:
                    return 0, 0.0
                gap = np.sqrt(squares[j]) - nearest
                passed[row, length], gaps[row, length] = tested[j], gap
                length += 1
                if tested[j] != winners[r]:
                    clear = min(clear, gap)
            j += 1
    return length, min(clear, REMEMBERED_M)


@njit(cache=True)
def _without_certain(length, reach, row, passed, gaps):
    """How many are left without the last round, if that has but one way to end, far from the round before it."""
    certain = length >= 2 and passed[row, length - 2] < 0 and gaps[row, length - 2] > reach
    return length - 2 if certain else length


@njit(cache=True)
def _repeated(p, slack, row, lengths, passed, gaps, rows, squares, bests):
    """Where the same walk ends, and barycentrics there; -1 for the face if a round ends at another one than before.

    Args:
        slack: twice the move, and what rounding does.
        squares, bests: filled with squared distances of what is looked at, -1 for the rest, and of the nearest of each
            round.
    """
    best, at, wanted, rounds = np.inf, -1, -1, 0
    u, v, w = 0.0, 0.0, 0.0
    for j in range(lengths[row]):
        f, squares[j] = passed[row, j], -1.0
        if f < 0:
            if at != wanted:
                return -1, u, v, w
            if rounds > 0:
                bests[rounds - 1] = best
            if gaps[row, j] > slack:
                best, at = np.inf, -1  # nearer ones follow for sure
            wanted, rounds = -1 - f, rounds + 1
        elif gaps[row, j] <= slack:
            squares[j], first, second, third = _to_face(p, rows, f)
            if squares[j] < best - NEARER_M2:
                best, at = squares[j], f
                u, v, w = first, second, third
    if at != wanted:
        return -1, u, v, w
    bests[rounds - 1] = best
    return at, u, v, w


@njit(cache=True)
def _renewed(slack, reach, row, lengths, passed, gaps, squares, bests):
    """Make the gaps those of a walk that was repeated; what was not looked at may have come nearer by the slack.

    Args:
        reach: what is farther is forgotten.
    Returns:
        How clear of any other way it is.
    """
    clear, held, winner, nearest, rounds, length = np.inf, np.inf, -1, np.inf, 0, 0
    for j in range(lengths[row]):
        f = passed[row, j]
        if f < 0:
            clear = min(clear, held)  # of all rounds but the last, which ends where the one before it did
            before, nearest, winner = nearest, np.sqrt(bests[rounds]), -1 - f
            gap = held = gaps[row, j] - slack if gaps[row, j] > slack else before - nearest
            rounds += 1
            if gap > reach:
                length = _without_certain(length, reach, row, passed, gaps)
        else:
            gap = gaps[row, j] - slack if squares[j] < 0.0 else np.sqrt(squares[j]) - nearest
            if gap > reach:
                continue
            if f != winner:
                clear = min(clear, gap)
        passed[row, length], gaps[row, length] = f, gap
        length += 1
    lengths[row] = length
    return min(clear, reach)


@njit(cache=True)
def _stand(p, rows, f, u, v, w, i, heights, directions, feet):
    """Fill row i with the height over a point of a face, the normal there, and the point.

    Sums are in numpy's order (of `einsum` the middle one last), in which this was computed before: the same to the bit.
    """
    for k in range(3):
        feet[i, k] = u * rows[f, k] + v * rows[f, 3 + k] + w * rows[f, 6 + k]
        directions[i, k] = u * rows[f, 9 + k] + v * rows[f, 12 + k] + w * rows[f, 15 + k]
    normal, apart = row3(directions, i), along3(p, 1.0, row3(feet, i), -1.0)
    length = max(np.sqrt(dot3(normal, normal)), 1e-12)
    x, y, z = normal[0] / length, normal[1] / length, normal[2] / length
    directions[i, 0], directions[i, 1], directions[i, 2] = x, y, z
    distance = np.sqrt(dot3(apart, apart))
    heights[i] = -distance if apart[0] * x + apart[2] * z + apart[1] * y < 0 else distance
