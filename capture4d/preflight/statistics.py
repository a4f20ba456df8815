"""What one scan, and one scan after another, says about a take: a few numbers per frame, so that a take of any length
is looked through in constant memory.

Lengths are metres, Y is up: a scan is brought there first (`capture4d.preflight.survey`). Letters: V vertices, F faces.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, UInt8
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import KDTree

from capture4d.colours.labels import FIRST_PAINT, GARMENT, OTHER, classify_colours
from capture4d.colours.spaces import Colour, colour_angles, to_lab
from capture4d.geometry.mesh import boundary_edges, doubled_area_vectors, face_areas, vertex_normals
from capture4d.geometry.mesh_kernels import open_vertices
from capture4d.types import Mesh, Rig, Scan

__all__ = [
    "ColourStatistics",
    "FrameStatistics",
    "Paints",
    "camera_counts",
    "colour_statistics",
    "hole_share",
    "measure_frame",
    "outwardness",
    "rig_middle",
    "surface_noise",
    "surface_shift",
]

NOISE_SAMPLES, NOISE_NEIGHBOURS = 600, 12


SHIFT_SAMPLES = 1500


RIG_SAMPLES, RIG_STEP_M = 200, 0.3


STRAY_DISTANCE_M = 0.06
"""Paint farther from the cloth than this is on something else: bands are a few centimetres wide."""


LARGEST_HOLE_M = 0.6
"""Rims longer than this are openings of the garment or the edge of the scanned volume."""


POSE_CLIP_M = 0.12
"""Hair, tools and strangers count no more than this in the distance to the posed body."""


WEDGE_DEG = 30.0
"""Hues within this angle of the garment's are the garment's, however pale."""


@dataclass(frozen=True, slots=True)
class Paints:
    """Colours that the take's description promises."""

    garment: Colour | None = None
    borders: tuple[Colour, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class ColourStatistics:
    """Colours of one scan. Shares are of its vertices."""

    chroma: float
    """CIELAB chroma that one vertex in a hundred exceeds."""
    clipped: float
    """Share of vertices at or near white in every channel."""
    garment: float
    """Share of garment-coloured vertices."""
    garment_chroma: float
    """Chroma that a hundredth of the vertices of the garment's hue exceed: a grey suit has some hue, but little chroma.
    NaN where there are hardly any."""
    garment_spread: float
    """Angle in linear RGB, radians, that 95 % of the garment's vertices keep to the garment's colour; NaN likewise."""
    borders: tuple[float, ...]
    """Share of each paint."""
    stray: tuple[float, ...]
    """Share of each paint's vertices that are far from any cloth."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameStatistics:
    """One frame in numbers."""

    frame_id: int
    vertices: int
    area_m2: float
    spacing_m: float
    """Median edge."""
    lower: Float64[np.ndarray, " 3"]
    upper: Float64[np.ndarray, " 3"]
    """Where all but half a percent of the vertices on either side lie."""
    centre: Float64[np.ndarray, " 3"]
    """Of the surface."""
    outwardness: float
    noise: float
    """Distance to the plane of the neighbours, in spacings."""
    hole_share: float
    """Area of holes over that of the surface."""
    content: str
    """Digest of the vertices: equal for the same frame twice."""
    colours: ColourStatistics | None = None
    camera_share: float | None = None
    """Share of the rig's cameras in whose images the garment lies, all of the subject if its colour is not known."""
    best_share: float | None = None
    """The same had the subject stood in the middle of the rig."""
    shift_m: float | None = None
    """How far the fastest parts of the surface moved since the frame before ..."""
    shift_from: int | None = None
    """... which was this one."""
    pose_distance_m: float | None = None
    """Mean distance of the bare subject, of all of it if the garment's colour is not known, to the posed body."""
    time_s: float | None = None
    """Time stamp in the file."""


def measure_frame(
    scan: Scan,
    paints: Paints,
    *,
    rig: Rig | None = None,
    body: Float[np.ndarray, "verts 3"] | None = None,
    has_colours: bool = True,
) -> FrameStatistics:
    """The numbers of one scan by itself.

    Args:
        body: posed body surface of the frame, metres.
        has_colours: the file had some; what a colourless scan carries in their place is not looked at.
    """
    mesh = scan.mesh
    vertices = mesh.vertices.astype(np.float64)
    corners = vertices[mesh.faces]
    doubled = np.linalg.norm(doubled_area_vectors(vertices, mesh.faces), axis=1)
    area = float(doubled.sum() / 2)
    lower, upper = np.percentile(vertices[mesh.faces[:, 0]], (0.5, 99.5), axis=0)
    dressed = np.zeros(len(vertices), bool)
    colours = None
    if has_colours:
        labels = _labels(scan.colours, paints)
        colours = colour_statistics(scan, labels, paints)
        dressed = labels > OTHER
    garment = (vertices[dressed] if dressed.mean() > 0.05 else vertices)[::7]
    bare = vertices[~dressed] if dressed.mean() < 0.85 else vertices
    return FrameStatistics(
        frame_id=scan.frame_id,
        vertices=len(vertices),
        area_m2=area,
        spacing_m=float(np.median(np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1))),
        lower=lower,
        upper=upper,
        centre=corners.mean(axis=1).T @ doubled / max(doubled.sum(), 1e-12),
        outwardness=outwardness(mesh),
        noise=surface_noise(mesh),
        hole_share=hole_share(mesh),
        content=hashlib.sha256(mesh.vertices.tobytes()).hexdigest()[:16],
        colours=colours,
        camera_share=None if rig is None else float(camera_counts(rig, garment).mean() / max(len(rig.names), 1)),
        best_share=None if rig is None else _best_share(rig, garment),
        pose_distance_m=None if body is None else _mean_distance(bare, body),
    )


def outwardness(mesh: Mesh) -> float:
    """How much the faces look away from the middle of the surface: +1 for a sphere, -1 for one inside out.

    It is the enclosed volume over that of a ball as far away, and bears holes well: a clothed person has 0.2 to 0.5.
    """
    vertices = mesh.vertices.astype(np.float64)
    normals = doubled_area_vectors(vertices, mesh.faces)
    size = np.linalg.norm(normals, axis=1)
    arms = vertices[mesh.faces].mean(axis=1)
    arms = arms - arms.T @ size / max(size.sum(), 1e-12)
    reach = float(np.linalg.norm(arms, axis=1) @ size)
    return float(np.einsum("fa,fa->", arms, normals) / max(reach, 1e-12))


def surface_noise(mesh: Mesh) -> float:
    """Median distance of vertices to the plane through their neighbours, in median neighbour distances.

    A smooth surface has almost none, whatever the density of its vertices; white noise of one spacing has about 0.6.
    """
    used = np.unique(mesh.faces)
    points = mesh.vertices[used].astype(np.float64)
    if len(points) <= NOISE_NEIGHBOURS:
        return 0.0
    chosen = np.linspace(0, len(points) - 1, min(NOISE_SAMPLES, len(points))).astype(int)
    tree = KDTree(points, balanced_tree=False, compact_nodes=False)
    distance, neighbours = tree.query(points[chosen], NOISE_NEIGHBOURS + 1)
    around = points[np.asarray(neighbours)[:, 1:]]
    centre = around.mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("nka,nkb->nab", around - centre, around - centre))
    off_plane = np.abs(np.einsum("na,na->n", points[chosen] - centre[:, 0], axes[:, :, 0]))
    return float(np.median(off_plane) / max(np.median(distance[:, 1:]), 1e-12))


def hole_share(mesh: Mesh) -> float:
    """Area of holes over the area of the surface, each hole taken as the circle of its rim.

    Rims longer than `LARGEST_HOLE_M` are not holes: necks, hems, and where the scanned volume ends.
    """
    is_open, _ = open_vertices(mesh.faces, len(mesh.vertices))
    rim = boundary_edges(mesh.faces[is_open[mesh.faces].sum(axis=1) >= 2])
    rim = rim[is_open[rim].all(axis=1)]
    if not len(rim):
        return 0.0
    area = face_areas(mesh.vertices.astype(np.float64), mesh.faces).sum()
    graph = sparse.coo_array((np.ones(len(rim), bool), (rim[:, 0], rim[:, 1])), shape=(len(mesh.vertices),) * 2)
    _, part = csgraph.connected_components(graph, directed=False)
    ends = mesh.vertices.astype(np.float64)[rim]
    length = np.bincount(part[rim[:, 0]], np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1))
    length = length[length <= LARGEST_HOLE_M]
    return float((length**2).sum() / (4 * np.pi) / max(area, 1e-12))


def surface_shift(before: Mesh, after: Mesh) -> float:
    """How far the fastest parts of a surface moved, metres: the 95th percentile of the distance to where it was.

    Distances are to the tangent planes of the earlier scan, so that its spacing is no floor; motion within the surface
    does not count, and motion farther than a limb is thick counts as that.
    """
    normals = vertex_normals(before.vertices.astype(np.float64), before.faces)
    sound = np.flatnonzero(np.linalg.norm(normals, axis=1) > 0.5)
    used = np.unique(after.faces)
    points = after.vertices[used[np.linspace(0, len(used) - 1, min(SHIFT_SAMPLES, len(used))).astype(int)]]
    tree = KDTree(before.vertices[sound], balanced_tree=False, compact_nodes=False)
    distance, nearest = tree.query(points.astype(np.float64))
    along = np.abs(np.einsum("na,na->n", points - before.vertices[sound[nearest]], normals[sound[nearest]]))
    # Where the nearest point is far along the surface, there was none before: a hole, or real motion across it.
    return float(np.percentile(np.minimum(along, distance), 95))


def _mean_distance(points: np.ndarray, body: np.ndarray) -> float:
    chosen = points[np.linspace(0, len(points) - 1, min(SHIFT_SAMPLES, len(points))).astype(int)]
    return float(np.minimum(KDTree(body).query(chosen, distance_upper_bound=POSE_CLIP_M)[0], POSE_CLIP_M).mean())


def camera_counts(rig: Rig, points: Float[np.ndarray, "points 3"]) -> np.ndarray:
    """In how many cameras' images each point lies, (points,); what hides it is not considered, nor lens distortion."""
    counts = np.zeros(len(points), np.int32)
    for camera in range(len(rig.names)):
        T, (width, height) = rig.T_camera_world[camera], rig.image_sizes[camera]
        seen = points @ T[:3, :3].T + T[:3, 3]
        pixels = seen @ rig.intrinsics[camera].T
        depth = np.maximum(pixels[:, 2], 1e-9)
        u, v = pixels[:, 0] / depth, pixels[:, 1] / depth
        counts += (seen[:, 2] > 0) & (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
    return counts


def rig_middle(rig: Rig) -> Float64[np.ndarray, " 3"]:
    """The point nearest to all optical axes, in the least squares sense; where it is not determined, that nearest to
    the cameras' mean."""
    axes = rig.T_camera_world[:, 2, :3]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    start = rig.centres.mean(axis=0)
    away = np.einsum("cab,cb->a", across, rig.centres - start)
    return start + np.linalg.pinv(across.sum(axis=0), rcond=1e-6) @ away


def _best_share(rig: Rig, points: np.ndarray) -> float:
    """Share of the cameras that would see the points, moved about the middle of the rig: the best of a few places."""
    few = points[:: max(1, len(points) // RIG_SAMPLES)]
    home = (rig_middle(rig) - few.mean(axis=0)) * (1, 0, 1)
    steps = (-RIG_STEP_M, 0.0, RIG_STEP_M)
    shares = [camera_counts(rig, few + home + (x, 0.0, z)).mean() for x in steps for z in steps]
    return float(max(shares) / max(len(rig.names), 1))


# --- colours -----------------------------------------------------------------------------------------------------


def colour_statistics(scan: Scan, labels: UInt8[np.ndarray, " verts"], paints: Paints) -> ColourStatistics:
    """Colours of a scan, against what its take promises.

    Args:
        labels: of the vertices, as `classify_colours` gives them; all 0 where the garment's colour is not known.
    """
    lab = to_lab(scan.colours)
    chroma = np.hypot(lab[:, 1], lab[:, 2])
    garment_chroma = spread = float("nan")
    if paints.garment is not None:
        wanted = to_lab(np.array([paints.garment], np.uint8))[0]
        turn = np.angle((lab[:, 1] + 1j * lab[:, 2]) * (wanted[1] - 1j * wanted[2]))
        own = (np.abs(turn) < np.radians(WEDGE_DEG)) & (chroma > 2)
        if own.mean() > 0.01:
            garment_chroma = float(np.percentile(chroma[own], 99))
        if (labels == GARMENT).mean() > 0.01:
            spread = float(np.percentile(colour_angles(scan.colours[labels == GARMENT], paints.garment), 95))
    count = max(len(labels), 1)
    borders = tuple(float((labels == FIRST_PAINT + i).sum() / count) for i in range(len(paints.borders)))
    return ColourStatistics(
        chroma=float(np.percentile(chroma, 99)) if len(chroma) else 0.0,
        clipped=float((scan.colours >= 250).all(axis=1).mean()) if len(chroma) else 0.0,
        garment=float((labels == GARMENT).mean()),
        garment_chroma=garment_chroma,
        garment_spread=spread,
        borders=borders,
        stray=_stray_shares(scan.mesh, labels, len(paints.borders)),
    )


def _labels(colours: np.ndarray, paints: Paints) -> np.ndarray:
    if paints.garment is None:
        return np.zeros(len(colours), np.uint8)
    return classify_colours(colours, paints.garment, paints.borders)


def _stray_shares(mesh: Mesh, labels: np.ndarray, paints: int) -> tuple[float, ...]:
    """Of each paint, how much lies too far from cloth to be its border."""
    cloth = mesh.vertices[labels == GARMENT]
    if not len(cloth):
        return (0.0,) * paints
    tree = KDTree(cloth[:: max(1, len(cloth) // 20_000)], balanced_tree=False, compact_nodes=False)
    shares = []
    for paint in range(FIRST_PAINT, FIRST_PAINT + paints):
        points = mesh.vertices[labels == paint]
        points = points[:: max(1, len(points) // 2000)]
        far = tree.query(points, distance_upper_bound=STRAY_DISTANCE_M)[0] if len(points) else np.zeros(0)
        shares.append(float(np.isinf(far).mean()) if len(far) else 0.0)
    return tuple(shares)
