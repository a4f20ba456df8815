"""A body in a loose shell of cloth, and points of it as a scan would have them: quick data for tracking.

The shell is the body's own trunk and upper arms pushed outwards, 3 mm on the shoulders and up to 4 cm at the waist,
with slow waves that travel over it. It hides what it covers. Nothing of this is simulated: real cloth comes from
`data_synth`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from capture4d.body.skinning import PosedBody
from capture4d.captures.points.scan_points import ScanPoints
from capture4d.geometry.mesh import doubled_area_vectors, face_areas, normalised, vertex_normals
from capture4d.types import Body, Mesh

__all__ = ["DressedBody", "covered_vertices", "dress_body", "sample_scan"]

COVERED = ("root", "pelvis", "spine", "clavicle", "shoulder01", "upperarm01")


@dataclass(frozen=True, slots=True, eq=False)
class DressedBody:
    """Surfaces of one frame, metres."""

    body: Mesh
    """What is bare."""
    garment: Mesh


def dress_body(posed: PosedBody, phase: float) -> DressedBody:
    """Body and shell in one pose; `phase` moves the waves."""
    body = posed.shaped.body
    vertices = posed.vertices()
    faces = body.template.faces
    covered, looseness = _cover(body)
    rest = posed.shaped.vertices
    waves = sum(np.sin(rest @ axis + phase * rate) for axis, rate in _WAVES) / len(_WAVES)
    offset = 0.003 + looseness * (0.022 + 0.018 * waves)
    shell = vertices + offset[:, None] * vertex_normals(vertices, faces)
    on_garment = covered[faces].all(axis=1)
    return DressedBody(_part(vertices, faces[~on_garment]), _part(shell, faces[on_garment]))


_WAVES = (
    (np.array((23.0, 9.0, 4.0)), 1.3),
    (np.array((-11.0, 17.0, 21.0)), 0.9),
    (np.array((5.0, -29.0, 13.0)), 2.1),
    (np.array((31.0, 3.0, -19.0)), 1.7),
)
"""Direction and frequency of each wave in space, radians a metre, and how fast it travels."""


def covered_vertices(body: Body) -> np.ndarray:
    """Vertices under the shell, (V,) bool."""
    return _cover(body)[0]


def _cover(body: Body) -> tuple[np.ndarray, np.ndarray]:
    """Which vertices the shell covers, and how loosely, 0 to 1: tight on the shoulders, loose below the arms."""
    named = np.array([name.startswith(COVERED) for name in body.joint_names])
    covered = body.skin_weights[:, named].sum(axis=1) > 0.5
    height = body.template.vertices[:, 1]
    shoulder = body.joints[body.joint_names.index("upperarm01.L"), 1]
    upwards = vertex_normals(body.template.vertices.astype(np.float64), body.template.faces)[:, 1]
    below = np.clip((shoulder - height) / 0.25, 0, 1)
    return covered, below**2 * (3 - 2 * below) * np.clip(1 - upwards, 0, 1)


def _part(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    used, renumbered = np.unique(faces, return_inverse=True)
    return Mesh(vertices[used].astype(np.float32), renumbered.reshape(-1, 3).astype(np.int32))


def sample_scan(
    dressed: DressedBody, rng: np.random.Generator, *, points: int = 5000, noise_m: float = 0.001, holes: int = 15
) -> ScanPoints:
    """Points by area, with noise, tilted normals and round holes of 3 to 8 cm."""
    parts = []
    total = [face_areas(mesh.vertices, mesh.faces) for mesh in (dressed.body, dressed.garment)]
    for mesh, areas, cloth in zip((dressed.body, dressed.garment), total, (False, True), strict=True):
        count = round(points * areas.sum() / sum(each.sum() for each in total))
        face = rng.choice(len(areas), count, p=areas / areas.sum())
        root, across = np.sqrt(rng.random(count)), rng.random(count)
        weights = np.stack([1 - root, root * (1 - across), root * across], axis=1)
        corners = mesh.vertices[mesh.faces[face]].astype(np.float64)
        normals = normalised(doubled_area_vectors(mesh.vertices.astype(np.float64), mesh.faces))[face]
        parts.append(((corners * weights[:, :, None]).sum(axis=1), normals, np.full(count, cloth)))
    places, normals, cloth = (np.concatenate(each) for each in zip(*parts, strict=True))
    places = places + noise_m * rng.standard_normal(places.shape)
    normals = normals + 0.15 * rng.standard_normal(normals.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    lost = np.zeros(len(places), bool)
    centres = places[rng.integers(len(places), size=holes)]
    for centre, found in zip(centres, KDTree(places).query_ball_point(centres, 0.08), strict=True):
        near = np.array(found)
        radius = rng.uniform(0.03, 0.08)
        lost[near[np.linalg.norm(places[near] - centre, axis=1) < radius]] = True
    order = rng.permutation(np.flatnonzero(~lost))
    return ScanPoints(places[order], normals[order], cloth[order])
