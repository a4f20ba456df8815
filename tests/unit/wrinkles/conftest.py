"""A small sleeve of cloth with seams, and scans of it that carry wrinkles."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture4d.captures.capture import Capture, write_capture_description
from capture4d.captures.garment_scans import save_garment_scan
from capture4d.files.atomic import write_bytes, write_npy, write_npz
from capture4d.files.records import save_garment
from capture4d.geometry.mesh import boundary_loops
from capture4d.runs.stage import open_stage
from capture4d.types import Garment, GarmentScan, Mesh
from tests.shapes import tube_faces


def sleeve(around: int, along: int) -> Mesh:
    """An open tube about Y, 0.2 m across and 0.5 m high, in two panels with UVs in metres, wound outwards."""
    angle = 2 * np.pi * np.arange(around) / around
    heights = np.linspace(0, 0.5, along)
    vertices = np.array([(0.1 * np.sin(a), y, 0.1 * np.cos(a)) for y in heights for a in angle], np.float32)
    faces = tube_faces(around, along)
    # unroll: u is arc length; the second half of the turn is a panel of its own, beside the first
    turn = angle[faces % around]
    turn = np.where((turn == 0) & (turn.max(axis=1, keepdims=True) > np.pi), 2 * np.pi, turn)
    u = 0.1 * turn + np.where(turn.mean(axis=1, keepdims=True) > np.pi, 0.1, 0.0)
    uv = np.stack([u, vertices[faces][..., 1]], axis=-1).astype(np.float32)
    return Mesh(vertices, faces, uv)


def some_garment() -> Garment:
    """The sleeve as a template."""
    mesh = sleeve(32, 24)
    low, high = sorted(boundary_loops(mesh.faces), key=lambda loop: mesh.vertices[loop, 1].mean())
    return Garment(mesh, {"hem": low, "neck": high})


def outside_the_unit_square(garment: Garment) -> Garment:
    """The same with a pattern that has to be packed for its maps."""
    mesh = garment.template
    assert mesh.uv is not None
    return replace(garment, template=replace(mesh, uv=mesh.uv + 1))


@pytest.fixture
def garment() -> Garment:
    return some_garment()


def wrinkled(points: np.ndarray, height_m: float = 0.002, phase: float = 0.0) -> np.ndarray:
    """Tube points moved in and out by waves of 50 mm along the tube."""
    radius = np.linalg.norm(points[:, [0, 2]], axis=1, keepdims=True)
    out = points / radius * np.array([1, 0, 1])
    return points + height_m * np.sin(2 * np.pi * points[:, 1:2] / 0.05 + phase) * out


def wrinkle_normals(points: np.ndarray, height_m: float = 0.002, phase: float = 0.0) -> np.ndarray:
    """Exact normals of the wrinkled tube above tube points."""
    out = points * np.array([1, 0, 1])
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    slope = height_m * 2 * np.pi / 0.05 * np.cos(2 * np.pi * points[:, 1:2] / 0.05 + phase)
    normal = out - slope * np.array([0, 1, 0])
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def from_tangent(normals: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Tangent-space normals (N, 3) in global coordinates; frames (N, 3, 3) have rows tangent, bitangent, normal."""
    return np.einsum("nrc,nr->nc", frames, normals)


def some_scan(*, height_m: float = 0.002, noise_m: float = 0.0, phase: float = 0.0, seed: int = 0) -> Mesh:
    """A fine sleeve with waves along it."""
    fine = sleeve(200, 170)
    points = wrinkled(fine.vertices.astype(float), height_m, phase)
    points += noise_m * np.random.default_rng(seed).standard_normal(points.shape)
    return Mesh(points.astype(np.float32), fine.faces)


@pytest.fixture
def scan_of() -> Callable[..., Mesh]:
    return some_scan


def make_work(folder: Path, garment: Garment, scans: list[Mesh], *, frame_ids: list[int] | None = None) -> Path:
    """A capture whose garment is cut out and registered, as the stages before leave it; the template does not move."""
    ids = frame_ids or list(range(1, len(scans) + 1))
    capture = Capture(folder / "capture", "sleeve", 60.0, tuple(ids), (47, 98, 201))
    write_capture_description(capture)
    for frame_id in ids:  # only their names matter once the garments are cut out
        write_bytes(capture.path / "scans" / f"{frame_id:06d}.ply", b"ply")
    work = folder / "work"
    cut = open_stage(work / "garment", name="extract", schema=1, config=None, upstream={},
                     sources={"capture": capture.path})  # fmt: skip
    placed = open_stage(work / "registration", name="register", schema=1, config=None, upstream={})
    vertices = garment.template.vertices
    save_garment(placed.path / "garment.npz", garment)
    none = np.zeros((0, 3), np.float32)
    for frame_id, scan in zip(ids, scans, strict=True):
        save_garment_scan(cut.frame_path(frame_id), GarmentScan(scan, none, none[:, 0].astype(np.int32), (), frame_id))
        write_npz(placed.frame_path(frame_id), vertices=vertices, residual_m=np.zeros(len(vertices), np.float32))
    write_npy(placed.path / "vertices.npy", np.tile(vertices, (len(ids), 1, 1)))
    cut.finish([cut.frame_path(frame_id) for frame_id in ids])
    placed.finish([placed.path / "vertices.npy"])
    return work
