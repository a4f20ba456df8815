"""Colours of a take, learned from a few of its scans without labels: garment, painted borders, and all the rest.

Light first. Neighbours on a scan are mostly of one material, so that what their colours differ by is light. The
logarithm of the light, channel by channel, is a polynomial in the normal and the place; it is fitted to differences of
neighbours, robustly, because at the edge of a paint they differ by more (the retinex assumption). Divided by the light,
a material is one colour wherever it is.

Then materials: modes of the density of colours, where the angle in linear RGB counts most and brightness a little.
Colours between two materials that are nowhere but between them are their blend.

Then roles. Paint is what lies in thin, long bands, and the garment is the piece of a scan that has the most paint, or,
where there is no paint, the most of other materials along its edges: the hem, the cuffs and the neck all belong to it,
while each piece of suit and skin has one or two of them.

References: Land and McCann, Lightness and retinex theory (JOSA 1971); Ramamoorthi and Hanrahan, An efficient
representation for irradiance environment maps (SIGGRAPH 2001), for the polynomial in the normal; Vedaldi and Soatto,
Quick shift and kernel methods for mode seeking (ECCV 2008).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Real, UInt8
from scipy.spatial import KDTree

from capture4d.colours.labels import settle_labels
from capture4d.colours.printed_cloth import between_paint, island_share, without_specks
from capture4d.colours.spaces import Colour, encode_colours, format_colour, linear_colours
from capture4d.errors import InputError
from capture4d.geometry.mesh import face_areas
from capture4d.geometry.mesh_kernels import face_components, open_vertices, vertex_normals_kernel
from capture4d.types import Mesh, Scan

__all__ = ["ColoursNotSeparableError", "Light", "TakeColours", "fit_light", "learn_colours"]

SAMPLES = 6000
"""Vertices of a scan that the light and the colours are learned from."""
NEIGHBOURS = 6
EDGE_SCALE = 0.06
"""Difference of log light between neighbours at which half of it is taken for paint."""
FLOOR = 0.004
"""Linear light added before logarithms: darker differences are noise."""
BRIGHTNESS_WEIGHT = 0.15
"""Radians of colour angle that a factor e of brightness counts for."""
KERNEL = 0.05
"""Width of the density's kernel, radians."""
MODE_DISTANCE = 0.16
"""Materials are at least this far apart, radians."""
LEAST_PAINT = 0.001
"""Share of the vertices that a given paint has to be seen on, to count where it is none of the frequent colours."""
MIN_SHARE = 0.003
"""Share of the vertices that a material has at least."""
BLEND_ANGLE = 0.06
"""A colour so near to the blends of two others may be one, radians."""
BAND_DEPTH_M = 0.02
"""Nine tenths of a band lie nearer to another colour, or to an open edge, than this: half the widest band."""
BAND_LENGTH = 4.0
"""Bands are so many times longer than wide."""
REACH_M = 0.015
"""Pieces of a scan that are nearer than this touch: a hem hangs free of the suit."""
LARGEST_PIECE = 0.3
"""No piece of one colour is a larger share of a printed cloth: cloth of one colour is whole but for holes."""
LOGO_SHARE = 0.005
"""Islands of other colours that make up more of a cloth are printed on it."""
MARGIN = 1.3
"""The garment has so much more paint along it than the next piece of another colour."""


class ColoursNotSeparableError(InputError):
    """The scans are sound, but do not say which colours are the garment's."""


@dataclass(frozen=True, slots=True, eq=False)
class Light:
    """The light on a take, relative to its mean, as a polynomial in the normal and the place."""

    coefficients: Float64[np.ndarray, "terms 3"]
    """Of the logarithm of linear red, green and blue."""
    centre: Float64[np.ndarray, " 3"]
    size_m: float

    def removed(self, mesh: Mesh, colours: UInt8[np.ndarray, "verts 3"]) -> UInt8[np.ndarray, "verts 3"]:
        """The colours of a scan as they would be under the mean light."""
        logarithm = _terms(mesh, self.centre, self.size_m) @ self.coefficients
        return encode_colours(linear_colours(colours) * np.exp(-logarithm))


@dataclass(frozen=True, slots=True, eq=False)
class TakeColours:
    """What the vertices of a take can be, as under its mean light; sRGB."""

    garment: Colour
    paints: tuple[Colour, ...]
    """On the borders, the most frequent first; empty if there are none."""
    others: tuple[Colour, ...]
    """Suit, skin, and whatever else is seen, the most frequent first; of printed cloth the other inks as well."""
    light: Light
    printed: bool = False
    """The cloth has many colours, of which `garment` is the most frequent."""


def learn_colours(
    scans: Sequence[Scan],
    *,
    garment: Colour | None = None,
    paints: Sequence[Colour] | None = None,
    source: str = "capture",
) -> TakeColours:
    """Learn what colours a take has.

    Args:
        scans: a few, spread over the take.
        garment: sRGB of the cloth if known; the material nearest to it is the garment.
        paints: sRGB of the paint on the borders if known, likewise; () if there is none.
        source: how errors call the take.
    Raises:
        ColoursNotSeparableError: fewer than two materials are seen, a known colour is not among them, or nothing
            tells the garment from the suit.
    """
    light = fit_light(scans)
    flat = [light.removed(scan.mesh, scan.colours) for scan in scans]
    seen = np.concatenate([_smoothed(s.mesh.faces, c) for s, c in zip(scans, flat, strict=True)])
    colours = _with_rare(_materials(seen), paints or (), seen)
    if len(colours) < 2:
        raise ColoursNotSeparableError(
            f"{source}: the colours of garment and suit are not separable: found {len(colours)} colour "
            f"({', '.join(format_colour(colour) for colour in colours)}) in {len(scans)} scans, expected at least 2"
        )
    labels = [
        settle_labels(scan.mesh.faces, _nearest(colour, colours)) for scan, colour in zip(scans, flat, strict=True)
    ]
    given_paints = None if paints is None else [_among(paint, colours, source, "border") for paint in paints]
    given_garment = None if garment is None else _among(garment, colours, source, "garment")
    bands = _bands(scans, labels, colours) if given_paints is None else given_paints
    if given_paints is not None:
        _require_apart([*given_paints, *([] if given_garment is None else [given_garment])], colours, source)
    bands = [band for band in bands if band != given_garment]
    ink = _ink(scans, labels, bands) if given_garment is None and given_paints else None
    cloth = ink if given_garment is None else given_garment
    if cloth is None:
        cloth = _garment(scans, labels, len(colours), bands, colours, source)
    others = [index for index in range(len(colours)) if index != cloth and index not in bands]
    return TakeColours(
        garment=colours[cloth],
        paints=tuple(colours[index] for index in bands),
        others=tuple(colours[index] for index in others),
        light=light,
        printed=ink is not None,
    )


# --- light -------------------------------------------------------------------------------------------------------


def fit_light(scans: Sequence[Scan]) -> Light:
    """The light on a take, from the differences of neighbours on its scans."""
    points = np.concatenate([scan.mesh.vertices for scan in scans]).astype(np.float64)
    centre, size = points.mean(axis=0), float(max(np.ptp(points, axis=0).max() / 2, 1e-6))
    design, target, means = [], [], []
    for scan in scans:
        chosen = _spread(len(scan.mesh.vertices), SAMPLES)
        terms = _terms(scan.mesh, centre, size)[chosen]
        value = np.log(linear_colours(_smoothed(scan.mesh.faces, scan.colours)[chosen]) + FLOOR)
        near = _neighbours(scan.mesh.vertices[chosen], NEIGHBOURS + 1)[1]
        start, end = np.repeat(np.arange(len(chosen)), NEIGHBOURS), near[:, 1:].reshape(-1)
        known = end < len(chosen)  # fewer points than neighbours
        start, end = start[known], end[known]
        design.append(terms[start] - terms[end])
        target.append(value[start] - value[end])
        means.append(terms.mean(axis=0))
    coefficients = _robust_fit(np.concatenate(design), np.concatenate(target))
    coefficients[0] = -(np.mean(means, axis=0)[1:] @ coefficients[1:])
    return Light(coefficients, centre, size)


def _robust_fit(design: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Iteratively reweighted least squares with a Cauchy weight; the constant term stays 0.

    All channels share the weights: paint changes them together.
    """
    solution = np.zeros((design.shape[1], target.shape[1]))
    varying = design[:, 1:]
    for _ in range(12):
        residual = target - design @ solution
        weight = 1 / (1 + ((residual / EDGE_SCALE) ** 2).sum(axis=1))
        weighted = varying * weight[:, None]
        ridge = 1e-6 * weight.sum() * np.eye(varying.shape[1])
        solution[1:] = np.linalg.solve(weighted.T @ varying + ridge, weighted.T @ target)
    return solution


def _terms(mesh: Mesh, centre: np.ndarray, size_m: float) -> Float64[np.ndarray, "verts terms"]:
    """1, the first two orders of the normal, and the place."""
    positions = mesh.vertices.astype(np.float64)
    x, y, z = vertex_normals_kernel(positions, mesh.faces).T
    place = (positions - centre) / size_m
    return np.column_stack([np.ones(len(x)), x, y, z, x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1, place])


def _neighbours(points: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Distances to the nearest points, each itself the first, and their indices."""
    distance, index = KDTree(points).query(points, count)
    return np.asarray(distance), np.asarray(index)


# --- materials ---------------------------------------------------------------------------------------------------


def _spread(count: int, wanted: int) -> np.ndarray:
    """At most so many indices, spread evenly."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(count, wanted)).round().astype(np.int64))


def _smoothed(faces: np.ndarray, colours: np.ndarray) -> UInt8[np.ndarray, "verts 3"]:
    """Each colour and the mean of its neighbours' in equal parts, for noise."""
    count = len(colours)
    corner, other = np.concatenate([faces, faces]).ravel(), np.roll(faces, 1, axis=1).ravel()
    other = np.concatenate([other, np.roll(faces, 2, axis=1).ravel()])
    weight = np.bincount(corner, minlength=count)[:, None]
    sums = np.stack([np.bincount(corner, colours[other, channel], minlength=count) for channel in range(3)], axis=1)
    mean = np.where(weight > 0, sums / np.maximum(weight, 1), colours)
    return np.rint((colours + mean) / 2).astype(np.uint8)


def _features(colours: Real[np.ndarray, "colours 3"]) -> Float64[np.ndarray, "colours 4"]:
    """Direction of linear RGB and, less important, its brightness: distances are close to radians of colour angle."""
    light = linear_colours(colours) + 1e-4
    brightness = np.linalg.norm(light, axis=1)
    return np.column_stack([light / brightness[:, None], BRIGHTNESS_WEIGHT * np.log(brightness)])


def _materials(colours: UInt8[np.ndarray, "verts 3"]) -> list[Colour]:
    """Modes of the density of colours, the most frequent first."""
    chosen, count = _cells(colours[_spread(len(colours), SAMPLES)])
    points = _features(chosen)
    tree = KDTree(points)
    pairs = tree.sparse_distance_matrix(tree, 3 * KERNEL, output_type="coo_matrix")
    weights = count[pairs.col] * np.exp(-((pairs.data / KERNEL) ** 2) / 2)
    density = np.bincount(pairs.row, weights, minlength=len(points))
    order = np.lexsort((np.arange(len(points)), -density))
    rank = np.empty(len(points), np.int64)
    rank[order] = np.arange(len(points))
    distance, near = _neighbours(points, min(48, len(points)))
    owner, modes = np.zeros(len(points), np.int64), np.zeros(0, np.int64)
    for point in order.tolist():
        denser = near[point][(rank[near[point]] < rank[point]) & (distance[point] < MODE_DISTANCE)]
        if len(denser):
            owner[point] = owner[denser[0]]
            continue
        apart = np.append(np.linalg.norm(points[modes] - points[point], axis=1), MODE_DISTANCE)
        owner[point] = int(apart.argmin())
        if owner[point] == len(modes):
            modes = np.append(modes, point)
    total = np.bincount(owner, count, minlength=len(modes))
    kept = [index for index in np.argsort(-total, kind="stable") if total[index] >= MIN_SHARE * count.sum()]
    materials = []
    for index in kept:
        near_mode = (owner == index) & (np.linalg.norm(points - points[modes[index]], axis=1) < 2 * KERNEL)
        red, green, blue = np.rint(np.average(chosen[near_mode], axis=0, weights=count[near_mode])).astype(int).tolist()
        materials.append((red, green, blue))
    return materials


def _cells(colours: UInt8[np.ndarray, "verts 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Colours that agree in six bits a channel as their mean, and how many there are of each."""
    codes = (colours >> 2).astype(np.int64) @ np.array([1 << 12, 1 << 6, 1])
    _, cell, count = np.unique(codes, return_inverse=True, return_counts=True)
    sums = [np.bincount(cell, colours[:, channel]) for channel in range(3)]
    return np.stack(sums, axis=1) / count[:, None], count


def _nearest(colours: UInt8[np.ndarray, "verts 3"], materials: Sequence[Colour]) -> UInt8[np.ndarray, " verts"]:
    nearest = KDTree(_features(np.array(materials, np.uint8))).query(_features(colours))[1]
    return np.asarray(nearest).astype(np.uint8)


def _angles(colour: Colour, colours: UInt8[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Angles in linear light between a colour and others, which shading leaves alone; and both in linear light."""
    given, found = (linear_colours(np.array(c, np.uint8).reshape(-1, 3)) for c in (colour, colours))
    cosine = found @ given[0] / np.maximum(np.linalg.norm(found, axis=1) * np.linalg.norm(given[0]), 1e-9)
    return np.arccos(np.clip(cosine, -1, 1)), given, found


def _with_rare(materials: list[Colour], paints: Sequence[Colour], seen: UInt8[np.ndarray, "n 3"]) -> list[Colour]:
    """The materials, and those of the given paints that are too rare among the colours of printed cloth to be one."""
    found = list(materials)
    for paint in paints:
        if found and _angles(paint, np.array(found, np.uint8))[0].min() <= 2 * MODE_DISTANCE:
            continue
        like = seen[_angles(paint, seen)[0] <= MODE_DISTANCE]
        if len(like) >= LEAST_PAINT * len(seen):
            red, green, blue = (int(channel) for channel in np.median(like, axis=0))
            found.append((red, green, blue))
    return found


def _among(colour: Colour, materials: Sequence[Colour], source: str, role: str) -> int:
    """The material that a colour someone gave stands for; shading may have changed its brightness."""
    angle, given, found = _angles(colour, np.array(materials, np.uint8))
    best = int(np.argmin(angle + 0.02 * np.abs(np.log((found.sum(axis=1) + 1e-4) / (given.sum() + 1e-4)))))
    if angle[best] > 2 * MODE_DISTANCE:
        raise ColoursNotSeparableError(
            f"{source}: {role} colour {format_colour(colour)} not found: expected it among the colours of the scans, "
            f"found {', '.join(format_colour(material) for material in materials)}"
        )
    return best


def _require_apart(chosen: Sequence[int], colours: Sequence[Colour], source: str) -> None:
    twice = [index for index in chosen if chosen.count(index) > 1]
    if twice:
        raise ColoursNotSeparableError(
            f"{source}: the colours given for garment and borders are not separable: two of them are "
            f"{format_colour(colours[twice[0]])} in the scans"
        )


# --- roles -------------------------------------------------------------------------------------------------------


def _bands(scans: Sequence[Scan], labels: Sequence[np.ndarray], colours: Sequence[Colour]) -> list[int]:
    """Materials that lie in thin, long bands, without those that are blends of others."""
    found = []
    for index in range(len(colours)):
        depth, area = [], 0.0
        for scan, label in zip(scans, labels, strict=True):
            own = np.flatnonzero(label == index)
            is_open, used = open_vertices(scan.mesh.faces, len(label))
            edge = np.flatnonzero(((label != index) | is_open) & used)
            if not len(own) or not len(edge):
                continue
            depth.append(KDTree(scan.mesh.vertices[edge]).query(scan.mesh.vertices[own])[0])
            area += len(own) * _vertex_area(scan.mesh)
        if not depth:
            continue
        all_depths = np.concatenate(depth)
        width = 4 * float(all_depths.mean()) + 1e-6
        if np.percentile(all_depths, 90) < BAND_DEPTH_M and area / len(scans) > BAND_LENGTH * width**2:
            found.append(index)
    pure = [index for index in found if not _is_blend(index, colours)]
    return pure or found[:1]


def _ink(scans: Sequence[Scan], labels: Sequence[np.ndarray], bands: Sequence[int]) -> int | None:
    """The most frequent material of a printed cloth; None where the cloth between the paint is of one colour.

    It is printed if no piece of one colour makes up much of it, as with blobs, stripes and checks, or if some of it
    lies in islands of other colours, as with a logo. Median over the scans: a hand may lie on the cloth in one.
    """
    largest, islands, inks = [], [], np.zeros(int(max(label.max(initial=0) for label in labels)) + 1)
    for scan, label in zip(scans, labels, strict=True):
        faces = scan.mesh.faces
        painted = without_specks(faces, np.isin(label, bands))
        cloth = between_paint(faces, painted)
        if not cloth.any():
            continue
        inside = cloth[faces].all(axis=1) & (label[faces] == label[faces][:, :1]).all(axis=1)
        piece = face_components(faces, len(label), inside)
        largest.append(np.bincount(piece[piece >= 0], minlength=1).max() / max(int(cloth[faces].all(axis=1).sum()), 1))
        own = np.bincount(label[cloth], minlength=len(inks))
        islands.append(island_share(faces, cloth & (label == own.argmax()), np.isin(label, bands)))
        inks += own
    if not largest or (np.median(largest) > LARGEST_PIECE and np.median(islands) < LOGO_SHARE):
        return None
    return int(inks.argmax())


def _vertex_area(mesh: Mesh) -> float:
    """Mean area that belongs to a vertex, square metres."""
    return float(face_areas(mesh.vertices.astype(np.float64), mesh.faces).sum() / max(len(mesh.vertices), 1))


def _is_blend(index: int, colours: Sequence[Colour]) -> bool:
    """Whether a colour lies between two more frequent ones."""
    light = linear_colours(np.array(colours, np.uint8))
    for first in range(index):
        for second in range(first):
            share = np.linspace(0.1, 0.9, 17)[:, None]
            blends = share * light[first] + (1 - share) * light[second]
            cosine = blends @ light[index] / np.linalg.norm(blends, axis=1) / np.linalg.norm(light[index])
            if np.arccos(np.clip(cosine, -1, 1)).min() < BLEND_ANGLE:
                return True
    return False


def _garment(
    scans: Sequence[Scan],
    labels: Sequence[np.ndarray],
    count: int,
    bands: Sequence[int],
    colours: Sequence[Colour],
    source: str,
) -> int:
    """The material of the piece with the most paint along it, or, without paint, the most of other materials."""
    contact = np.zeros(count)
    for scan, label in zip(scans, labels, strict=True):
        faces = scan.mesh.faces
        uniform = (label[faces] == label[faces][:, :1]).all(axis=1)
        piece = face_components(faces, len(label), uniform & ~np.isin(label[faces[:, 0]], bands))
        size = np.bincount(piece[piece >= 0], minlength=len(label))
        large = np.flatnonzero(size > 0.005 * len(faces))
        edges = {int(root): np.unique(faces[piece == root]) for root in large}
        paint = np.flatnonzero(np.isin(label, bands))
        for own in edges.values():
            index = int(label[own[0]])
            apart = (
                paint
                if bands
                else np.concatenate(
                    [other for key, other in edges.items() if int(label[other[0]]) != index] or [np.zeros(0, np.int64)]
                )
            )
            if not len(apart):
                continue
            near = KDTree(scan.mesh.vertices[own]).query(scan.mesh.vertices[apart], distance_upper_bound=REACH_M)[0]
            contact[index] = max(contact[index], float(np.isfinite(near).sum()) / len(label))
    ranked = np.argsort(-contact, kind="stable")
    if contact[ranked[0]] == 0 or contact[ranked[0]] < MARGIN * contact[ranked[1]]:
        raise ColoursNotSeparableError(
            f"{source}: nothing tells the garment from the rest: {format_colour(colours[ranked[0]])} and "
            f"{format_colour(colours[ranked[1]])} have as much of other colours along them; "
            "give garment_colour in capture.json"
        )
    return int(ranked[0])
