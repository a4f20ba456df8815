"""What one scan, and one scan after another, says about a take: a few numbers per frame, so that a take of any length
is looked through in constant memory.

Lengths are metres, Y is up: a scan is brought there first (`capture4d.preflight.survey`). Letters: V vertices, F faces.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import KDTree

from capture4d.cameras.coverage import best_share, camera_counts
from capture4d.colours.labels import OTHER
from capture4d.geometry.mesh import boundary_edges, doubled_area_vectors, face_areas, vertex_normals
from capture4d.geometry.mesh_kernels import open_vertices
from capture4d.preflight.colour_statistics import ColourStatistics, colour_statistics, paint_labels
from capture4d.preflight.facts import Paints
from capture4d.types import Mesh, Rig, Scan

__all__ = [
    "FrameStatistics",
    "hole_share",
    "measure_frame",
    "outwardness",
    "surface_noise",
    "surface_shift",
]

NOISE_SAMPLES, NOISE_NEIGHBOURS = 600, 12
SHIFT_SAMPLES = 1500
LARGEST_HOLE_M = 0.6
"""Rims longer than this are openings of the garment or the edge of the scanned volume."""
POSE_CLIP_M = 0.12
"""Hair, tools and strangers count no more than this in the distance to the posed body."""


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
    estimated: bool = False
    """The file has points alone."""
    notes: tuple[str, ...] = ()
    """The file's name and what in it could not be used."""


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
        labels = paint_labels(scan.colours, paints)
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
        best_share=None if rig is None else best_share(rig, garment),
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
