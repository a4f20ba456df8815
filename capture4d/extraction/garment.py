"""The garment of a coloured scan: cut out by colour, with the points of its painted borders.

Paints are told apart by chroma: the direction of linear RGB, which shading hardly changes, and a wide band of lightness
around the paint's own. Vertices of mixed colour between two paints go with the majority of their neighbours; only parts
that contain garment colour survive, so that a hand of the border's colour does not.

A border point comes from a vertex on an open edge of what was cut out, whether the scan ends there or the next colour
begins, that lies on the far side of the paint: along the surface it is almost a band's width away from garment colour.
Rims of occlusion holes are nearer, or not on paint, and drop out. A scan stops short of its borders; the points are
moved outwards by what is missing. Where a scan goes on to the body behind, the border is found from the inner rim of
the paint instead (`band_borders`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from scipy import sparse
from scipy.sparse import csgraph

from capture4d.captures.take_colours import KnownColours
from capture4d.colours.labels import FIRST_PAINT, GARMENT, OTHER, classify_colours, settle_labels
from capture4d.colours.printed_cloth import label_print
from capture4d.colours.spaces import Colour, format_colour
from capture4d.errors import InputError
from capture4d.extraction.band_borders import border_beyond_rim
from capture4d.extraction.border_loops import loop_order, name_loops, straighten
from capture4d.extraction.label_edges import sharpen_labels
from capture4d.extraction.paint_rim import inner_rim
from capture4d.geometry.mesh_kernels import face_components, open_vertices
from capture4d.types import GarmentScan, Mesh, Scan

__all__ = ["ColourNotFoundError", "cut_out", "extract_garment", "painted_border"]

MIN_SHARE = 1e-3
"""Share of the scan's vertices below which a paint counts as not found."""


MOST_SHARE = 0.5
"""Share of the scan's vertices above which what resembles a paint is the cloth."""


MIN_PART = 0.005
"""Parts with a smaller share of the garment's faces are dropped."""


FAR_SIDE = 0.6
"""A border point is at least this share of the band's width away from garment colour."""


EROSION = 0.9
"""Sample spacings by which fused scans stop short of an open border (measured against the synthetic scanner)."""


LOST, LOST_SPREADS = 1.6, 1.45
"""What scans of bare cloth lose of the band's width in the median: so many sample spacings, but not more than so many
times the differences of width (20 to 90 %), for a scan that ends cleanly loses nothing. One point has lost 1 to 2.3
spacings; with what it has kept, that makes the same width to within 1.5 mm (`benchmarks.painted_shirts`)."""


BARE_SHARE = 0.95
"""Of a scan's vertices; where more are garment, there is no body."""


CONNECTED = 0.2
"""Share of a border's open vertices where the scan goes on, above which the border is found from the inner rim."""


MIN_PIECE = 0.08
"""Share of a paint's open vertices below which a piece of it is not asked how wide the paint is."""


STRAIGHTENED = 3.0
"""Border points are drawn to the line through their neighbours within so many sample spacings."""


EVEN_BAND = 2.0
"""A band counts as even if its widths (20 to 90 %) differ by less than this many sample spacings."""


class ColourNotFoundError(InputError):
    """The scan is sound, but the garment or a painted border is not in it."""


def extract_garment(
    scan: Scan,
    garment_colour: Colour,
    boundary_colours: Mapping[str, Colour],
    *,
    other_colours: tuple[Colour, ...] = (),
    printed: bool = False,
    as_scanned: UInt8[np.ndarray, "verts 3"] | None = None,
    settled: UInt8[np.ndarray, " verts"] | None = None,
    source: str = "scan",
) -> GarmentScan:
    """Cut the garment out of a scan.

    Args:
        garment_colour: sRGB of the cloth.
        boundary_colours: sRGB of the paint on each named border; equal colours cannot tell their loops apart.
        other_colours: sRGB of what else there is, where it is known: suit, skin.
        printed: the garment has many colours, of which `garment_colour` is but one: it is what lies between the paint.
        as_scanned: sRGB that the garment keeps, if the scan's are changed.
        settled: the scan's labels by these colours, as `label_scan` has them, if they are known already.
        source: how errors call the scan, usually its path.
    Raises:
        ColourNotFoundError: the garment's or a border's colour is not in the scan.
    """
    paints = tuple(dict.fromkeys(boundary_colours.values()))
    labels = classify_colours(scan.colours, garment_colour, paints, others=other_colours)
    _require_colours(labels, None if printed else garment_colour, paints, source)
    faces = scan.mesh.faces
    if settled is None:
        settled = settle_labels(faces, labels)
        settled = label_print(faces, settled) if printed else settled
    labels = settled
    mask = _garment_faces(faces, labels)
    if not mask.any():
        raise ColourNotFoundError(
            f"{source}: expected a connected garment of colour {format_colour(garment_colour)}, found scattered specks"
        )
    used = np.zeros(len(labels), bool)
    used[faces[mask].reshape(-1)] = True
    renumbered = (np.cumsum(used) - 1).astype(np.int32)
    mesh = Mesh(scan.mesh.vertices[used], renumbered[faces[mask]])
    kept = labels[used]
    whole = _Whole(scan, np.where(used, labels, OTHER), ~open_vertices(faces, len(labels))[0][used])
    points, paint = _border_points(mesh, kept, len(paints), whole)
    loop_of_paint = _loops_of_paints(boundary_colours, paints)
    return GarmentScan(
        mesh=mesh,
        boundary_points=points,
        boundary_loops=loop_of_paint[paint.astype(np.int64) - FIRST_PAINT],
        loop_names=tuple(boundary_colours),
        frame_id=scan.frame_id,
        colours=(scan.colours if as_scanned is None else as_scanned)[used],
    )


def painted_border(
    mesh: Mesh, colours: UInt8[np.ndarray, "verts 3"], paint: Colour, *, source: str = "scan"
) -> tuple[Float32[np.ndarray, "points 3"], Float64[np.ndarray, "rim 3"]]:
    """Points on the border of a scan that is all garment, whatever its colours, but for one paint; and on the inner rim
    of that paint.

    Raises:
        ColourNotFoundError: the paint is not in the scan.
    """
    painted = classify_colours(colours, paint, ()) == GARMENT
    if painted.mean() > MOST_SHARE:
        cloth = np.median(colours, axis=0).astype(int).tolist()
        painted = classify_colours(colours, paint, (), others=((cloth[0], cloth[1], cloth[2]),)) == GARMENT
    if painted.mean() < MIN_SHARE:
        raise ColourNotFoundError(
            f"{source}: border colour {format_colour(paint)} not found: expected at least {100 * MIN_SHARE:g} % of the "
            f"vertices, found {100 * painted.mean():.2g} %"
        )
    labels = settle_labels(mesh.faces, np.where(painted, FIRST_PAINT, GARMENT).astype(np.uint8))
    return _border_points(mesh, labels, 1)[0], inner_rim(mesh, colours, labels == FIRST_PAINT)


def _require_colours(labels: np.ndarray, garment: Colour | None, paints: tuple[Colour, ...], source: str) -> None:
    """Raise where the paints, or the one colour of a garment that has one, are hardly seen."""
    share = np.bincount(labels, minlength=FIRST_PAINT + len(paints)) / max(len(labels), 1)
    wanted = [("garment colour", garment, 10 * MIN_SHARE), *(("border colour", p, MIN_SHARE) for p in paints)]
    for index, (name, colour, least) in enumerate(wanted, start=GARMENT):
        if colour is not None and share[index] < least:
            raise ColourNotFoundError(
                f"{source}: {name} {format_colour(colour)} not found: expected at least "
                f"{100 * least:g} % of the vertices, found {100 * share[index]:.2g} %"
            )


def _garment_faces(faces: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Faces on garment or paint, in parts that are large enough and contain garment colour."""
    marked = labels > OTHER
    active = marked[faces[:, 0]] & marked[faces[:, 1]] & marked[faces[:, 2]]
    part = face_components(faces, len(labels), active)
    inside = part >= 0
    size = np.bincount(part[inside], minlength=len(labels))
    cloth = np.bincount(part[inside], labels[faces[inside, 0]] == GARMENT, minlength=len(labels))
    keep = (size >= MIN_PART * inside.sum()) & (cloth > 0.2 * size)
    return inside & keep[np.maximum(part, 0)]


@dataclass(frozen=True, slots=True, eq=False)
class _Whole:
    """The scan that a garment was cut out of."""

    scan: Scan
    labels: np.ndarray
    """(V,) of its vertices; those that were not cut out are OTHER."""
    goes_on: np.ndarray
    """Vertices of what was cut out around which the scan has no open edge."""


def _border_points(
    mesh: Mesh, labels: np.ndarray, paints: int, whole: _Whole | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Points on the true border, float32, and the paint of each.

    Args:
        whole: what `mesh` was cut out of; None if it is all there is.

    Where the scan mostly goes on, the border is found from the inner rim of the paint (`band_borders`), because the
    outer one bends to what is behind it. Where it ends there, it ends about a sample before the surface does, and
    sometimes several: if the band is of even width, each open vertex is moved outwards by what is missing from that
    width; else by the one sample.
    """
    points, labels_of = [np.zeros((0, 3), np.float32)], [np.zeros(0, labels.dtype)]
    if not paints:
        return points[0], labels_of[0]
    band = _across_the_paint(mesh, labels)
    rim, inner = band.rim, band.nearest[band.rim_here]
    outer = mesh.vertices[rim].astype(np.float64)
    across = outer - inner
    straight = np.linalg.norm(across, axis=1)
    spacing = _spacing(mesh)
    paint_here = labels[rim]
    sharp: np.ndarray | None = None
    ends = np.zeros(len(rim), bool) if whole is None else whole.goes_on[rim]
    for paint in range(FIRST_PAINT, FIRST_PAINT + paints):
        own = np.flatnonzero(paint_here == paint)
        if not len(own):
            continue
        own = own[straight[own] >= FAR_SIDE * np.percentile(straight[own], 75)]
        if whole is not None and ends[own].mean() > CONNECTED:
            if sharp is None:
                sharp = sharpen_labels(whole.scan.mesh, whole.scan.colours, whole.labels)
            found = border_beyond_rim(whole.scan.mesh, sharp == GARMENT, sharp == paint)
        else:
            bare = whole is None or len(labels) > BARE_SHARE * len(whole.labels)
            pieces = None if bare else _pieces(mesh, labels == paint, rim[own])
            width = _width(straight[own], pieces, spacing)
            missing = np.full(len(own), EROSION * spacing)
            if width is not None:
                missing = np.clip(width - straight[own], 0.0, 2.5 * spacing)
            found = outer[own] + (missing / straight[own])[:, None] * across[own]
        points.append(straighten(found, STRAIGHTENED * spacing).astype(np.float32))
        labels_of.append(np.full(len(points[-1]), paint, labels.dtype))
    return np.concatenate(points), np.concatenate(labels_of)


def _pieces(mesh: Mesh, painted: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Which connected piece of the paint each of some painted vertices is on; -1 on none."""
    part = face_components(mesh.faces, len(painted), painted[mesh.faces].all(axis=1))
    piece_of = np.full(len(painted), -1)
    piece_of[mesh.faces[part >= 0]] = part[part >= 0, None]
    return piece_of[vertices]


def _width(straight: np.ndarray, pieces: np.ndarray | None, spacing: float) -> float | None:
    """How wide a paint is that a scan has lost the edge of, metres; None where no piece of it is of even width.

    On a dressed person some of the border lies on the body, and that is scanned to its end. Bare cloth may lose
    something all along.

    Args:
        straight: what is left of its width at the scan's open vertices.
        pieces: the connected piece of paint of each, on a dressed person; None of bare cloth.
    """
    narrow, middle, full = np.percentile(straight, (20, 50, 90))
    if pieces is None:
        if full - narrow >= EVEN_BAND * spacing:
            return None
        return max(full + 0.2 * spacing, middle + min(LOST * spacing, LOST_SPREADS * (full - narrow)))
    for piece in np.unique(pieces[pieces >= 0]):
        own = straight[pieces == piece]
        if len(own) >= MIN_PIECE * len(straight) and np.ptp(np.percentile(own, (20, 90))) < EVEN_BAND * spacing:
            return float(full + 0.2 * spacing)
    return None


def _spacing(mesh: Mesh) -> float:
    """Mean edge length of a sample of the faces, metres."""
    some = mesh.faces[:: max(1, len(mesh.faces) // 2000)]
    return float(np.linalg.norm(mesh.vertices[some[:, 0]] - mesh.vertices[some[:, 1]], axis=1).mean())


@dataclass(frozen=True, slots=True, eq=False)
class _Band:
    """What is painted, and the garment vertices next to it."""

    vertices: np.ndarray
    """Of the mesh: the paint and its neighbours."""
    nearest: np.ndarray
    """Position of the garment vertex there."""
    rim_here: np.ndarray
    """Open painted vertices that are connected to garment colour, as indices into `vertices`."""

    @property
    def rim(self) -> np.ndarray:
        return self.vertices[self.rim_here]


def _across_the_paint(mesh: Mesh, labels: np.ndarray) -> _Band:
    """The way from garment colour across the paint, along the surface: a cuff may touch the flank."""
    is_open, _ = open_vertices(mesh.faces, len(mesh.vertices))
    painted = labels >= FIRST_PAINT
    near = painted[mesh.faces[:, 0]] | painted[mesh.faces[:, 1]] | painted[mesh.faces[:, 2]]
    local, renumbered = np.unique(mesh.faces[near], return_inverse=True)
    corners = renumbered.reshape(-1, 3)
    pairs = np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]), axis=1)
    keys = np.unique(pairs[:, 0].astype(np.int64) * len(local) + pairs[:, 1])
    start, end = keys // max(len(local), 1), keys % max(len(local), 1)
    positions = mesh.vertices[local].astype(np.float64)
    length = np.maximum(np.linalg.norm(positions[start] - positions[end], axis=1), 1e-9)
    graph = sparse.csr_array((length, (start, end)), shape=(len(local), len(local)))
    sources = np.flatnonzero(~painted[local])
    source = np.full(len(local), -1)
    if len(sources):
        _, _, source = csgraph.dijkstra(graph, directed=False, indices=sources, min_only=True, return_predecessors=True)
    rim = np.flatnonzero(is_open[local] & painted[local] & (source >= 0))
    return _Band(local, positions[source], rim)


def _loops_of_paints(boundary_colours: Mapping[str, Colour], paints: tuple[Colour, ...]) -> np.ndarray:
    """The loop each paint stands for, or -1 where several loops wear it."""
    colours = list(boundary_colours.values())
    return np.array([colours.index(paint) if colours.count(paint) == 1 else -1 for paint in paints], np.int32)


def cut_out(
    scan: Scan,
    colours: KnownColours,
    *,
    flat: Scan | None = None,
    settled: UInt8[np.ndarray, " verts"] | None = None,
    source: str = "scan",
) -> GarmentScan:
    """The garment of one scan of the take.

    Args:
        flat: the scan in the light that the colours hold for, and ...
        settled: ... its labels, if they are known already.
    Raises:
        ColourNotFoundError: the scan is sound, but the garment or a paint is not in it.
    """
    garment = extract_garment(
        colours.flat(scan) if flat is None else flat, colours.garment, colours.boundary, settled=settled,
        other_colours=colours.others, printed=colours.printed, as_scanned=scan.colours, source=source,
    )  # fmt: skip
    if colours.light is None:
        return garment
    if colours.loop_names != garment.loop_names:
        unknown = np.full(len(garment.boundary_points), -1, np.int32)
        garment = replace(garment, boundary_loops=unknown, loop_names=colours.loop_names)
    if (garment.boundary_loops < 0).all():
        named = name_loops(garment.boundary_points, garment.loop_names, garment.mesh.vertices)
        garment = replace(garment, boundary_loops=named)
    return _in_order(garment)


def _in_order(garment: GarmentScan) -> GarmentScan:
    """Border points loop by loop, each in order around it; those of no known loop last."""
    points, loops = garment.boundary_points, garment.boundary_loops
    parts = [np.flatnonzero(loops == loop) for loop in range(len(garment.loop_names))]
    parts = [own[loop_order(points[own])] for own in parts if len(own) > 2]
    known = np.concatenate([*parts, np.zeros(0, np.int64)])
    order = np.concatenate([known, np.setdiff1d(np.arange(len(points)), known)])
    return replace(garment, boundary_points=points[order], boundary_loops=loops[order])
