"""A tube of cloth on a tube of a body, in styles and poses whose displacements are known in closed form."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.body.skinning import skin, with_pose, with_shape
from capture4d.captures.drapes.drape_sets import DrapeSet
from capture4d.captures.drapes.style_sets import CanonicalDrapes, Ranges, StylePair, StyleSet
from capture4d.files.atomic import write_json, write_npz
from capture4d.files.records import save_body, save_garment
from capture4d.runs.stage import open_stage
from capture4d.types import Body, Garment, Mesh, PoseSequence
from retarget.mixture.lesson import person_under
from tests.shapes import tube

AROUND, ALONG = 10, 7
RANGES = Ranges({"length": (0.4, 0.8)}, [(-1.0, 1.0)])
UNSEEN = 3
"""Drapes numbered up to this are not learned from."""


def _body() -> Body:
    """Two bones along Y; the one shape direction makes it thicker."""
    mesh = tube(8, 9, radius=0.1, height=0.8)
    bend = np.clip((mesh.vertices[:, 1] - 0.3) / 0.2, 0, 1)
    outwards = mesh.vertices * (0.2, 0, 0.2)
    return Body(
        template=mesh,
        shape_directions=outwards[None].astype(np.float32),
        joints=np.array([[0, 0.0, 0], [0, 0.4, 0], [0, 0.8, 0]], np.float32),
        joint_directions=np.zeros((1, 3, 3), np.float32),
        joint_names=("root", "knee", "toe"),
        parents=np.array([-1, 0, 1], np.int32),
        skin_weights=np.stack([1 - bend, bend, 0 * bend], axis=1).astype(np.float32),
    )


def canonical_displacement(garment: Garment, style: float, shape: float) -> np.ndarray:
    """Wider with the style, tighter on a thick person; linear in both."""
    vertices = garment.template.vertices.astype(np.float64)
    length = (style - 0.6) / 0.2
    return vertices * (0.3 + 0.2 * length, 0.1 * length, 0.3 + 0.2 * length) - 0.05 * shape * vertices * (1, 0, 1)


def pose_displacement(garment: Garment, angle: float, style: float) -> np.ndarray:
    """A smooth bulge and a fine wave that grow with the bend, the wave more in long styles."""
    x, y, z = garment.template.vertices.astype(np.float64).T
    bulge = 0.1 * angle * np.column_stack([0 * x, 0 * y, y * (0.8 - y)])
    wave = 0.01 * angle * (1 + style) * np.sin(20 * np.pi * y)[:, None] * np.column_stack([x, 0 * x, z]) / 0.12
    return bulge + wave


def _garment(body: Body) -> Garment:
    """A tube around it, bound to the nearest faces."""
    mesh = tube(AROUND, ALONG, radius=0.12, height=0.7, start=0.05)
    bend = np.clip((mesh.vertices[:, 1] - 0.3) / 0.2, 0, 1)
    nearest = np.argmin(
        np.linalg.norm(mesh.vertices[:, None] - body.template.vertices[body.template.faces].mean(axis=1), axis=2),
        axis=1,
    )
    return Garment(
        Mesh(mesh.vertices, mesh.faces),
        embedding_faces=nearest.astype(np.int32),
        embedding_barycentric=np.full((len(mesh.vertices), 3), 1 / 3, np.float32),
        skin_weights=np.stack([1 - bend, bend, 0 * bend], axis=1).astype(np.float32),
        body_shape=np.zeros(1, np.float32),
    )


def bent(angles: np.ndarray) -> np.ndarray:
    """Joint rotations, (N, 3, 3, 3): the knee alone bends."""
    rotations = np.repeat(np.repeat(np.eye(3)[None, None], 3, axis=1), len(angles), axis=0)
    rotations[:, 1] = Rotation.from_euler("x", angles[:, None]).as_matrix()
    return rotations.astype(np.float32)


def _pair(name: str, style: float, shape: float, garment: Garment, body: Body, angles: np.ndarray) -> StylePair:
    person = with_shape(body, np.array([shape], np.float32))
    under = person_under(garment, body, np.array([shape], np.float32))
    at_rest = under + canonical_displacement(garment, style, shape)
    rotations, vertices = bent(angles), []
    for angle, pose in zip(angles, rotations, strict=True):
        assert garment.skin_weights is not None
        unposed = at_rest + pose_displacement(garment, float(angle), style)
        vertices.append(skin(unposed, garment.skin_weights, with_pose(person, pose, np.zeros(3)).transforms))
    drapes = DrapeSet(
        "trousers", garment, body, {"length": style, "ease": 0.1}, np.array([shape], np.float32),
        np.arange(1, len(angles) + 1, dtype=np.int32), rotations, np.array(vertices, np.float32),
        np.ones(len(angles), bool),
    )  # fmt: skip
    role = "test" if name.startswith("test") else "prototype"
    return StylePair(name, role, drapes, at_rest.astype(np.float32), {"length": style})


@pytest.fixture(scope="session")
def style_set() -> StyleSet:
    return made_style_set()


def made_style_set() -> StyleSet:
    """Four prototypes at the corners, two test pairs; three unseen poses."""
    body = _body()
    garment = _garment(body)
    corners = [(style, shape) for style in (0.4, 0.8) for shape in (-1.0, 1.0)]
    tests = [(0.5, 0.5), (0.65, -0.3)]
    angles = np.concatenate([[0.35, 0.75, 1.1], np.linspace(0, 1.3, 14)])
    pairs = [
        _pair(f"prototype-{k}", *pair, garment, body, angles) for k, pair in enumerate(corners, 1)
    ]  # fmt: skip
    pairs += [_pair(f"test-{k}", *pair, garment, body, angles[: UNSEEN + 4]) for k, pair in enumerate(tests, 1)]
    grid = [(style, shape) for style in (0.4, 0.6, 0.8) for shape in (-1.0, 0.0, 1.0)] + tests
    at_rest = [
        person_under(garment, body, np.array([shape], np.float32)) + canonical_displacement(garment, style, shape)
        for style, shape in grid
    ]
    canonical = CanonicalDrapes(
        np.array([[style] for style, _ in grid]), np.array([[shape] for _, shape in grid]),
        np.array(at_rest, np.float32), np.array([False] * 9 + [True] * 2),
    )  # fmt: skip
    return StyleSet(RANGES, pairs, canonical, UNSEEN, "digest")


def motion(angles: list[float], places: np.ndarray | None = None) -> PoseSequence:
    """The knee bends, the root is moved."""
    count = len(angles)
    places = np.zeros((count, 3)) if places is None else places
    return PoseSequence(
        bent(np.array(angles)), places.astype(np.float32), np.zeros(1, np.float32),
        np.arange(count, dtype=np.int32), 60.0, ("root", "knee", "toe"),
    )  # fmt: skip


def write_style_set(folder: Path, styles: StyleSet) -> None:
    """A style set as the documents say that it lies on disk."""
    stage = open_stage(folder, name="synth-styles", schema=1, config={}, upstream={})
    rows = [
        int(np.flatnonzero((styles.canonical.vertices == pair.canonical).all(axis=(1, 2)))[0]) for pair in styles.pairs
    ]
    for pair in styles.pairs:
        place, drapes = folder / "pairs" / pair.name, pair.drapes
        inner = open_stage(place, name="synth-drapes", schema=1, config={}, upstream={})
        save_garment(place / "garment.npz", drapes.garment)
        save_body(place / "body.npz", drapes.body)
        write_json(
            place / "drapes.json", {"garment": drapes.name, "style": drapes.style, "shape": drapes.shape.tolist()}
        )
        for number, part in enumerate(np.array_split(np.arange(len(drapes.numbers)), 2), 1):
            write_npz(
                place / "shards" / f"{number:06d}.npz", drapes=drapes.numbers[part], rotations=drapes.rotations[part],
                vertices=drapes.vertices[part], kept=drapes.kept[part],
            )  # fmt: skip
        inner.finish([place / "drapes.json"])
    at_rest = styles.canonical
    write_npz(
        folder / "canonical.npz", styles=at_rest.styles, shapes=at_rest.shapes, vertices=at_rest.vertices,
        test=at_rest.test,
    )  # fmt: skip
    about = {
        "style_ranges": {name: list(limits) for name, limits in styles.ranges.style.items()},
        "shape_ranges": [list(limits) for limits in styles.ranges.shape],
        "unseen_poses": styles.unseen_poses,
        "pairs": {
            pair.name: {"role": pair.role, "canonical": row} for pair, row in zip(styles.pairs, rows, strict=True)
        },
    }
    write_json(folder / "styles.json", about)
    stage.finish([folder / "styles.json", folder / "canonical.npz"])
