"""Whole dressed people as somebody else's capture would deliver them: pairs of meshes, with the truth between them.

A person of the parametric body wears loose clothes, which are the body's own surface pushed outwards: a shirt that
hangs below the hips, sleeves, trousers. Folds come and go with the pose, and lengths are kept. What is registered has
nothing of that surface's triangles: the template is a closed mesh that Poisson reconstruction put around one pose, and
the scan is either made in the same way or fused from virtual depth cameras, with round holes; it has 1 mm of noise at
every vertex. Which piece of cloth a template vertex is, its nearest triangle on the person's own surface tells.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from capture4d.body.anny import load_anny
from capture4d.body.skinning import ShapedBody, skin, with_pose, with_shape
from capture4d.cache import user_cache_folder
from capture4d.files.atomic import write_npz
from capture4d.geometry.mesh import doubled_area_vectors, face_areas, normalised, unique_edges, vertex_normals
from capture4d.geometry.mesh_kernels import mean_edge_length
from capture4d.geometry.ray_casting import closest_points
from capture4d.heavy_imports import import_open3d, njit
from capture4d.types import Mesh
from data_synth.motions import random_pose
from data_synth.scanner.config import FusionConfig, NoiseConfig, RigConfig, ScannerConfig
from data_synth.scanner.rig import bounding_sphere, scanner_rig
from data_synth.scanner.scan import LABEL_GARMENT, Surface, scan_surfaces

__all__ = [
    "MORE",
    "PEOPLE",
    "SUBJECTS",
    "Clothes",
    "PeoplePair",
    "Person",
    "draw_people",
    "draw_shape",
    "make_pair",
    "standing",
    "way_to",
]

VERSION = 4
"""Of what is kept in the user's cache; raise it when these pairs change."""
SUBJECTS: tuple[tuple[float, ...], ...] = ((0.0, 0.0), (1.3, -1.2), (-1.2, 1.3), (0.6, 1.8, 0.8), (-0.8, -1.0, -1.0))
"""Shape coefficients: height, girth, a third."""
OTHERS: tuple[tuple[float, ...], ...] = ((0.7, -0.6, 1.0), (-0.6, 0.5, -0.4), (1.0, 1.1, 0.0))
"""The same of the people of `MORE`; they are numbered on from `SUBJECTS`."""
DRAWN = ((0.14, 100_000), (0.14, 10_000), (0.06, 100_000), (0.14, 100_000), (0.14, 10_000), (0.02, 10_000))
"""How far people who are drawn move, metres, and what their scans have of vertices."""
MOST_SHAPE = 1.8
"""Largest shape coefficient that is drawn."""
TEMPLATE_VERTICES = 10_000
NOISE_M = 0.001
LENGTH_SWEEPS = 200
KNOWN_M = 0.004
"""Template vertices farther from the person's own surface, as in the web of an armpit, are no piece of it."""
WHOLE_SCAN_VOXEL_M = 0.0048
"""Gives scans of some 100,000 vertices."""


@dataclass(frozen=True, slots=True)
class Person:
    """Who moves how far, and who scans it."""

    subject: int
    motion_m: float
    """Mean distance that the surface moves from template to scan."""
    scan_vertices: int
    """10,000: closed, by Poisson reconstruction; 100,000: fused from depth cameras, with holes."""
    seed: int
    drawn: tuple[float, ...] = ()
    """The shape of one who is none of the numbered subjects."""

    @property
    def shape(self) -> tuple[float, ...]:
        return self.drawn or (*SUBJECTS, *OTHERS)[self.subject]

    @property
    def name(self) -> str:
        return f"person {self.subject}, {1e3 * self.motion_m:.0f} mm, {self.scan_vertices // 1000}k"


PEOPLE: tuple[Person, ...] = (
    Person(0, 0.02, 100_000, 1),
    Person(1, 0.06, 10_000, 2),
    Person(2, 0.06, 100_000, 3),
    Person(3, 0.02, 10_000, 4),
    Person(4, 0.14, 100_000, 5),
    Person(0, 0.14, 10_000, 6),
    Person(1, 0.14, 100_000, 7),
    Person(2, 0.14, 10_000, 8),
    Person(3, 0.14, 100_000, 9),
    Person(4, 0.06, 10_000, 10),
)
MORE: tuple[Person, ...] = (
    Person(5, 0.14, 100_000, 11),
    Person(6, 0.14, 10_000, 12),
    Person(7, 0.14, 100_000, 13),
    Person(5, 0.06, 10_000, 14),
    Person(6, 0.02, 100_000, 15),
    Person(7, 0.14, 10_000, 16),
    Person(5, 0.14, 100_000, 17),
    Person(6, 0.14, 100_000, 18),
)
"""Others, of whom the far ones have chosen settings as well."""


def draw_people(seed: int) -> tuple[Person, ...]:
    """People of whom nobody knows yet: shapes, clothes, poses and noise are all drawn, four of six at 140 mm.

    A seed whose results have chosen a setting is held out no more.
    """
    rng = np.random.default_rng([VERSION, 1000, seed])
    return tuple(
        Person(index, motion_m, vertices, 1000 * (seed + 1) + index, draw_shape(rng))
        for index, (motion_m, vertices) in enumerate(DRAWN)
    )


def draw_shape(rng: np.random.Generator) -> tuple[float, ...]:
    """Height, girth and a third coefficient."""
    return tuple(np.clip(rng.standard_normal(3), -MOST_SHAPE, MOST_SHAPE).round(2).tolist())


@dataclass(frozen=True, slots=True, eq=False)
class PeoplePair:
    """A template, a scan, and the truth; metres."""

    name: str
    template: Mesh
    scan: Mesh
    truth: Mesh
    """The person's own surface in the pose of the scan, without noise."""
    places: Float64[np.ndarray, "verts 3"]
    """Where the template's vertices truly are."""
    known: Bool[np.ndarray, " verts"]
    """Whether a vertex is a piece of the person at all."""

    @property
    def covered(self) -> Bool[np.ndarray, " verts"]:
        """Whether the scan shows the true place of a vertex."""
        reach = 0.75 * mean_edge_length(self.scan.vertices.astype(np.float64), self.scan.faces)
        return self.known & (KDTree(self.scan.vertices).query(self.places)[0] < max(0.006, reach))


def make_pair(person: Person) -> PeoplePair:
    """One pair, from the user's cache; made there first, in 5 to 10 CPU seconds."""
    key = hashlib.sha256(repr((VERSION, person, person.shape)).encode()).hexdigest()[:12]
    path = user_cache_folder() / "people" / f"{key}.npz"
    if not path.exists():
        made = _make(person)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_npz(path, **made)
    with np.load(path) as stored:
        part = {name: stored[name] for name in stored.files}
    meshes = {n: Mesh(part[f"{n}_vertices"], part[f"{n}_faces"]) for n in ("template", "scan", "truth")}
    return PeoplePair(person.name, **meshes, places=part["places"], known=part["known"])


def _make(person: Person) -> Mapping[str, np.ndarray]:
    rng = np.random.default_rng([VERSION, person.seed])
    clothes = Clothes.tailor(with_shape(load_anny(), np.array(person.shape)), rng)
    first = standing(clothes.shaped, rng)
    last = random_pose(clothes.shaped, rng)
    _turn_legs(clothes.shaped, last, rng)
    before, after = way_to(clothes, first, last, person.motion_m)
    faces = clothes.faces
    template = _reconstructed(before, faces, TEMPLATE_VERTICES, rng)
    if person.scan_vertices <= TEMPLATE_VERTICES:
        scan = _reconstructed(after, faces, person.scan_vertices, rng)
    else:
        scan = _scanned(after, faces, rng)
    noise = NOISE_M * rng.standard_normal(len(scan.vertices))
    normals = vertex_normals(scan.vertices.astype(np.float64), scan.faces)
    scan = scan.with_vertices((scan.vertices + noise[:, None] * normals).astype(np.float32))
    own = Mesh(before.astype(np.float32), faces)
    found, face, barycentric = closest_points(own, template.vertices)
    off = template.vertices - found
    there = normalised(doubled_area_vectors(after, faces))[face]
    here = normalised(doubled_area_vectors(before, faces))[face]
    height = np.einsum("va,va->v", off, here)
    places = np.einsum("vc,vca->va", barycentric, after[faces[face]]) + height[:, None] * there
    return {
        "template_vertices": template.vertices,
        "template_faces": template.faces,
        "scan_vertices": scan.vertices,
        "scan_faces": scan.faces,
        "truth_vertices": after.astype(np.float32),
        "truth_faces": faces,
        "places": places,
        "known": np.linalg.norm(off, axis=1) < KNOWN_M,
    }


# --- clothes -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Clothes:
    """A person's surface, dressed: rest positions, skin weights, how loosely cloth lies where, and its folds."""

    shaped: ShapedBody
    rest: np.ndarray
    normals: np.ndarray
    weights: np.ndarray
    faces: np.ndarray
    looseness: np.ndarray
    """Metres from the skin, 0 where it is bare."""
    waves: tuple[tuple[np.ndarray, float, float, float], ...]
    """Of each: direction, radians a metre; phase; how fast it travels; amplitude as a share of the looseness."""

    @staticmethod
    def tailor(shaped: ShapedBody, rng: np.random.Generator) -> Clothes:
        body = shaped.body
        rest, weights, faces = _refined(shaped.vertices, body.skin_weights.astype(np.float64), body.template.faces)
        normals = vertex_normals(rest, faces)
        looseness = _looseness(shaped, rest, weights, rng)
        waves = []
        for length_m, amplitude in ((0.30, 0.30), (0.18, 0.30), (0.11, 0.18), (0.07, 0.10), (0.045, 0.05)):
            for _ in range(3):
                direction = rng.standard_normal(3) * [1.0, 0.7, 1.0]
                direction *= 2 * np.pi / length_m / np.linalg.norm(direction)
                waves.append((direction, rng.uniform(0, 2 * np.pi), rng.uniform(0.1, 0.8), amplitude))
        return Clothes(shaped, rest, normals, weights, faces, looseness, tuple(waves))

    def surface(self, pose: np.ndarray, progress: float) -> np.ndarray:
        """The dressed surface in a pose; `progress`, 0 to 1, moves the folds and the whole person a little."""
        folds = sum(
            amplitude * np.sin(self.rest @ direction + phase + rate * progress)
            for direction, phase, rate, amplitude in self.waves
        )
        calm = 0.5 + 0.5 * np.sin(self.rest @ np.array([9.0, 7.0, 11.0]) + 1.3)
        offset = self.looseness * (1.0 + np.clip(calm * folds, -0.9, 1.2))
        dressed = self.rest + offset[:, None] * self.normals
        posed = with_pose(self.shaped, pose, progress * np.array([0.03, -0.01, 0.02]))
        return skin(dressed, self.weights, posed.transforms)


def _refined(vertices: np.ndarray, weights: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Every edge halved."""
    edges = unique_edges(faces)
    count = len(vertices)
    keys = edges[:, 0].astype(np.int64) * count + edges[:, 1]
    sides = np.sort(np.stack([faces, faces[:, [1, 2, 0]]], axis=2), axis=2).astype(np.int64)
    middle = count + np.searchsorted(keys, sides[:, :, 0] * count + sides[:, :, 1]).astype(np.int32)
    a, b, c = faces.T
    ab, bc, ca = middle.T
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    finer = np.concatenate([np.stack(part, axis=1) for part in parts]).astype(np.int32)
    halves = [np.concatenate([values, values[edges].mean(axis=1)]) for values in (vertices, weights)]
    return halves[0], halves[1], finer


def _looseness(shaped: ShapedBody, rest: np.ndarray, weights: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Metres of air and cloth over the skin: a shirt, its sleeves, trousers; none on head, hands and feet."""
    names = np.array(shaped.body.joint_names)

    def share(*starts: str) -> np.ndarray:
        return weights[:, [name.startswith(starts) for name in names]].sum(axis=1)

    joint = {name: shaped.joints[index] for index, name in enumerate(names)}
    trunk = share("root", "pelvis", "spine", "clavicle", "shoulder01")
    arm, leg = share("upperarm", "lowerarm"), share("upperleg", "lowerleg")
    shoulder, hip = joint["upperarm01.L"][1], joint["upperleg01.L"][1]
    hem = hip - rng.uniform(0.05, 0.16)
    below = np.clip((shoulder - rest[:, 1]) / 0.35, 0.0, 1.0)
    shirt = (0.006 + rng.uniform(0.015, 0.035) * below**2) * (rest[:, 1] > hem)
    sleeve_end = rng.choice([0.35, 0.85])
    along = np.zeros(len(rest))
    for side in "LR":
        start, end = joint[f"upperarm01.{side}"], joint[f"wrist.{side}"]
        axis = (end - start) / ((end - start) @ (end - start))
        own = weights[:, [name.startswith(("upperarm", "lowerarm")) and name.endswith(side) for name in names]]
        along = np.where(own.sum(axis=1) > 0.3, (rest - start) @ axis, along)
    sleeves = (0.008 + rng.uniform(0.006, 0.016) * np.clip(along, 0, 1)) * (along < sleeve_end)
    ankle = joint["foot.L"][1]
    trousers = (0.008 + rng.uniform(0.008, 0.02) * np.clip((hip - rest[:, 1]) / (hip - ankle), 0, 1)) * (
        rest[:, 1] > ankle + 0.04
    )
    hanging = np.where(rest[:, 1] > hem, np.maximum(shirt, 0.012), trousers)
    cloth = np.maximum(np.maximum(trunk, leg) * hanging, arm * sleeves)
    return cloth * (share("head", "neck02", "neck03", "wrist", "foot") < 0.5)


# --- poses -------------------------------------------------------------------------------------------------------


def standing(shaped: ShapedBody, rng: np.random.Generator) -> np.ndarray:
    """Arms away from the trunk, as subjects are asked to stand; a little different each time."""
    names = shaped.body.joint_names
    pose = np.repeat(np.eye(3)[None], len(names), axis=0)
    for side, sign in (("L", 1), ("R", -1)):
        angle = sign * rng.uniform(-5, 45)
        pose[names.index(f"upperarm01.{side}")] = Rotation.from_euler("z", angle, degrees=True).as_matrix()
        angle = sign * rng.uniform(2, 9)
        pose[names.index(f"upperleg01.{side}")] = Rotation.from_euler("z", angle, degrees=True).as_matrix()
    return pose


def _turn_legs(shaped: ShapedBody, pose: np.ndarray, rng: np.random.Generator) -> None:
    """Legs lifted, spread and bent, each in its own way."""
    names = shaped.body.joint_names
    for side, sign in (("L", 1), ("R", -1)):
        lift, apart, knee = rng.uniform(-20, 45), rng.uniform(2, 20), rng.uniform(0, 60)
        hip = Rotation.from_euler("xz", [-lift, sign * apart], degrees=True)
        pose[names.index(f"upperleg01.{side}")] = hip.as_matrix()
        pose[names.index(f"lowerleg01.{side}")] = Rotation.from_euler("x", knee, degrees=True).as_matrix()


def way_to(clothes: Clothes, first: np.ndarray, last: np.ndarray, motion_m: float) -> tuple[np.ndarray, np.ndarray]:
    """The surface in one pose, and so far on the way to another, or beyond it, that it has moved by `motion_m`."""
    before = clothes.surface(first, 0.0)
    turn = (Rotation.from_matrix(last) * Rotation.from_matrix(first).inv()).as_rotvec()
    low, high, surface = 0.0, 1.6, before
    areas = face_areas(before, clothes.faces)
    for _ in range(12):
        middle = (low + high) / 2
        pose = Rotation.from_rotvec(middle * turn).as_matrix() @ first
        surface = clothes.surface(pose, middle)
        moved = np.linalg.norm(surface - before, axis=1)[clothes.faces].mean(axis=1)
        if np.average(moved, weights=areas) < motion_m:
            low = middle
        else:
            high = middle
    return before, _lengths_kept(before, surface, clothes.faces)


def _lengths_kept(before: np.ndarray, after: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """What skinning and folds made, with the lengths of the cloth in the first pose: cloth hardly stretches."""
    edges = unique_edges(faces)
    lengths = np.linalg.norm(before[edges[:, 1]] - before[edges[:, 0]], axis=1)
    return keep_lengths(after.copy(), edges, lengths, LENGTH_SWEEPS)


@njit(cache=True)
def keep_lengths(vertices, edges, lengths, sweeps):
    """Gauss-Seidel over edges, to and fro; shortened edges push back more weakly than stretched ones pull."""
    count = len(edges)
    for sweep in range(sweeps):
        for n in range(count):
            e = n if sweep % 2 == 0 else count - 1 - n
            a, b = edges[e, 0], edges[e, 1]
            x = vertices[b, 0] - vertices[a, 0]
            y = vertices[b, 1] - vertices[a, 1]
            z = vertices[b, 2] - vertices[a, 2]
            now = np.sqrt(x * x + y * y + z * z) + 1e-12
            off = now - lengths[e]
            share = (0.5 if off > 0 else 0.25) * 0.5 * off / now
            for axis, along in enumerate((x, y, z)):
                vertices[a, axis] += share * along
                vertices[b, axis] -= share * along
    return vertices


# --- meshes ------------------------------------------------------------------------------------------------------


def _seen(vertices: np.ndarray, faces: np.ndarray, voxel_m: float, rng: np.random.Generator) -> Mesh:
    """What depth cameras all around see, fused."""
    scanner = ScannerConfig(
        rig=RigConfig(cameras=40, image_size=640),
        noise=NoiseConfig(sigma_m=0.0002, blob_loss=0.0),
        fusion=FusionConfig(garment_voxel_m=voxel_m),
    )
    centre, radius = bounding_sphere(vertices)
    rig = scanner_rig(scanner, centre=centre, radius=radius)
    grey = np.full((len(vertices), 3), 150, np.uint8)
    surface = Surface(Mesh(vertices.astype(np.float32), faces), grey, LABEL_GARMENT, voxel_m)
    return scan_surfaces(rig, [surface], config=scanner, rng=rng)[0].mesh


def _scanned(vertices: np.ndarray, faces: np.ndarray, rng: np.random.Generator) -> Mesh:
    """Fused, with the holes that cameras leave and a dozen more of 2 to 6 cm."""
    mesh = _seen(vertices, faces, WHOLE_SCAN_VOXEL_M, rng)
    lost = np.zeros(len(mesh.vertices), bool)
    for centre in mesh.vertices[rng.integers(len(mesh.vertices), size=12)]:
        lost |= np.linalg.norm(mesh.vertices - centre, axis=1) < rng.uniform(0.01, 0.03)
    kept = mesh.faces[~lost[mesh.faces].any(axis=1)]
    used, renumbered = np.unique(kept, return_inverse=True)
    return Mesh(mesh.vertices[used], renumbered.reshape(-1, 3).astype(np.int32))


def _reconstructed(vertices: np.ndarray, faces: np.ndarray, count: int, rng: np.random.Generator) -> Mesh:
    """A closed mesh of about `count` vertices: Poisson reconstruction of what is seen, thinned by quadric error."""
    o3d = import_open3d()
    seen = _seen(vertices, faces, 0.008, rng)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(seen.vertices.astype(np.float64)))
    cloud.normals = o3d.utility.Vector3dVector(vertex_normals(seen.vertices.astype(np.float64), seen.faces))
    closed, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=8, n_threads=1)
    clusters, sizes, _ = (np.asarray(each) for each in closed.cluster_connected_triangles())
    closed.remove_triangles_by_mask(clusters != int(np.argmax(sizes)))
    closed.remove_unreferenced_vertices()
    thin = closed.simplify_quadric_decimation(2 * count)
    return Mesh(np.asarray(thin.vertices, np.float32), np.asarray(thin.triangles, np.int32))
