"""A small person for tests of garments and motions: no cache, no download, made in a second."""

from __future__ import annotations

import numpy as np
import pytest

from capture4d.body.skinning import ShapedBody, with_shape
from capture4d.types import Body, Mesh

JOINTS = {  # name: (parent, position); the skeleton of the parametric body, limbs reduced to tubes
    "root": ("", (0, 0.95, 0)),
    "spine04": ("root", (0, 1.1, 0)),
    "spine03": ("spine04", (0, 1.2, 0)),
    "spine02": ("spine03", (0, 1.3, 0)),
    "spine01": ("spine02", (0, 1.4, 0)),
    "neck01": ("spine01", (0, 1.5, 0)),
    "neck02": ("neck01", (0, 1.55, 0)),
    "head": ("neck02", (0, 1.62, 0)),
}
for _side, _sign in (("L", 1), ("R", -1)):
    JOINTS |= {
        f"clavicle.{_side}": ("spine01", (_sign * 0.03, 1.42, 0)),
        f"upperarm01.{_side}": (f"clavicle.{_side}", (_sign * 0.18, 1.42, 0)),
        f"lowerarm01.{_side}": (f"upperarm01.{_side}", (_sign * 0.36, 1.22, 0)),
        f"wrist.{_side}": (f"lowerarm01.{_side}", (_sign * 0.53, 1.04, 0)),
        f"upperleg01.{_side}": ("root", (_sign * 0.1, 0.9, 0)),
        f"lowerleg01.{_side}": (f"upperleg01.{_side}", (_sign * 0.11, 0.48, 0)),
        f"foot.{_side}": (f"lowerleg01.{_side}", (_sign * 0.12, 0.08, 0)),
    }


def _tube(start: np.ndarray, end: np.ndarray, radii: tuple[float, float]) -> np.ndarray:
    """Rings of points around a bone, (96, 3)."""
    along = (end - start) / np.linalg.norm(end - start)
    first = np.cross(along, (0.0, 0.0, 1.0))
    first /= np.linalg.norm(first)
    second = np.cross(along, first)
    angles = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    ring = radii[0] * np.cos(angles)[:, None] * first + radii[1] * np.sin(angles)[:, None] * second
    return np.concatenate([start + share * (end - start) + ring for share in np.linspace(0, 1, 6)])


def _tube_faces(offset: int) -> np.ndarray:
    rows = [
        face
        for r in range(5)
        for k in range(16)
        for a, b, c, d in [(r * 16 + k, r * 16 + (k + 1) % 16, (r + 1) * 16 + k, (r + 1) * 16 + (k + 1) % 16)]
        for face in ((a, b, c), (b, d, c))
    ]
    return np.array(rows) + offset


@pytest.fixture(scope="session")
def person() -> ShapedBody:
    """A jointed mannequin of open tubes, arms about 48 degrees below the horizontal, facing +Z."""
    names = list(JOINTS)
    positions = np.array([position for _, position in JOINTS.values()], float)
    parents = np.array([names.index(parent) if parent else -1 for parent, _ in JOINTS.values()])
    vertices, faces, owners = [], [], []
    for joint in range(1, len(names)):
        start, end = positions[parents[joint]], positions[joint]
        wide = names[joint].startswith(("spine", "neck01"))
        vertices.append(_tube(start, end, (0.16, 0.11) if wide else (0.045, 0.045)))
        faces.append(_tube_faces(96 * (joint - 1)))
        owners += [parents[joint]] * 96
    weights = np.zeros((len(owners), len(names)), np.float32)
    weights[np.arange(len(owners)), owners] = 1
    points = np.concatenate(vertices).astype(np.float32)
    body = Body(
        template=Mesh(points, np.concatenate(faces).astype(np.int32)),
        shape_directions=np.zeros((1, len(points), 3), np.float32),
        joints=positions.astype(np.float32),
        joint_directions=np.zeros((1, len(names), 3), np.float32),
        joint_names=tuple(names),
        parents=parents.astype(np.int32),
        skin_weights=weights,
    )
    return with_shape(body, np.zeros(1, np.float32))
