"""A work folder with a garment that moves, as `animate` leaves one: a tube with a seam around a limb of six joints."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from capture4d.body.skinning import pose_frame, skin, with_shape
from capture4d.captures.work_folder import ANIMATE, stack_vertices
from capture4d.files.atomic import write_bytes, write_npz
from capture4d.files.records import save_body, save_garment, save_poses
from capture4d.runs.stage import open_stage
from capture4d.types import Body, Garment, Mesh, PoseSequence
from tests.shapes import tube

AROUND, ALONG, JOINTS = 24, 14, 6
NAMES = tuple(f"joint_{each}" for each in range(JOINTS))


def limb() -> Body:
    mesh = tube(16, 12, 0.1, 0.7, -0.1)
    joints = np.stack([np.zeros(JOINTS), 0.1 * np.arange(JOINTS), np.zeros(JOINTS)], axis=1).astype(np.float32)
    return Body(
        template=mesh,
        shape_directions=np.zeros((1, len(mesh.vertices), 3), np.float32),
        joints=joints,
        joint_directions=np.zeros((1, JOINTS, 3), np.float32),
        joint_names=NAMES,
        parents=np.arange(-1, JOINTS - 1, dtype=np.int32),
        skin_weights=weights(mesh.vertices[:, 1]),
    )


def weights(height: np.ndarray) -> np.ndarray:
    """(V, J): of all joints, so that four are not enough."""
    near = np.exp(-(((height[:, None] - 0.1 * np.arange(JOINTS)) / 0.12) ** 2))
    return (near / near.sum(axis=1, keepdims=True)).astype(np.float32)


def cloth() -> Mesh:
    """A tube whose UVs fill a part of the unit square; its first and last column meet in a seam."""
    mesh = tube(AROUND, ALONG, 0.13)
    column = (mesh.faces % AROUND).astype(np.float64)
    column[(column.max(axis=1) == AROUND - 1)[:, None] & (column == 0)] = AROUND
    uv = np.stack([0.05 + 0.9 * column / AROUND, 0.05 + 0.6 * (mesh.faces // AROUND) / ALONG], axis=2)
    return Mesh(mesh.vertices, mesh.faces, uv.astype(np.float32))


def motion(frames: int, *, seed: int, fps: float, first: int, step: int = 1) -> PoseSequence:
    rng = np.random.default_rng(seed)
    time, axes = np.arange(frames) / fps, rng.standard_normal((JOINTS, 3))
    angles = 0.4 * np.sin(2 * np.pi * time[:, None] * rng.uniform(0.3, 1.2, JOINTS) + rng.uniform(0, 6, JOINTS))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    turns = Rotation.from_rotvec((angles[..., None] * axes).reshape(-1, 3)).as_matrix().reshape(frames, JOINTS, 3, 3)
    places = 0.2 * np.sin(time[:, None] * rng.uniform(0.5, 2, 3))
    ids = first + step * np.arange(frames, dtype=np.int32)
    return PoseSequence(
        turns.astype(np.float32), places.astype(np.float32), np.zeros(1, np.float32), ids.astype(np.int32), fps, NAMES
    )


def folds(mesh: Mesh, frames: int, seed: int, waves: int = 5) -> np.ndarray:
    """(T, V, 3) float64: what a garment does over its skeleton, metres: waves around and along it, outwards."""
    rng = np.random.default_rng(seed + 100)
    around, height = np.arctan2(mesh.vertices[:, 0], mesh.vertices[:, 2]), mesh.vertices[:, 1] / 0.5
    turns, rises, phases = rng.integers(1, 5, waves), rng.uniform(0, 3, waves), rng.uniform(0, 6, waves)
    outwards = np.stack([np.sin(around), np.zeros_like(around), np.cos(around)], axis=1)
    waving = np.cos(np.outer(turns, around) + 2 * np.pi * np.outer(rises, height) + phases[:, None])
    directions = waving[..., None] * outwards
    return 0.004 * np.einsum("tk,kvc->tvc", rng.standard_normal((frames, waves)).cumsum(axis=0) / 3, directions)


def write_moving_work(
    work: Path, frames: int = 8, *, seed: int = 0, fps: float = 25.0, first: int = 1, step: int = 1, maps: int = 0
) -> np.ndarray:
    """Write it.

    Args:
        maps: bits of its normal maps; 0 for none.
    Returns:
        Vertices (T, V, 3) float32.
    """
    body, mesh, poses = limb(), cloth(), motion(frames, seed=seed, fps=fps, first=first, step=step)
    garment = Garment(mesh, skin_weights=weights(mesh.vertices[:, 1]), body_shape=np.zeros(1, np.float32))
    (work / "body").mkdir(parents=True)
    save_body(work / "body" / "body.npz", body)
    save_poses(work / "body" / "poses.npz", poses)
    stage = open_stage(work / "registration", name=ANIMATE, schema=2, config={}, upstream={"motion": str(seed)})
    save_garment(stage.path / "garment.npz", garment)
    assert garment.skin_weights is not None
    shaped, moved = with_shape(body, poses.shape), folds(mesh, frames, seed)
    for row, frame_id in enumerate(poses.frame_ids.tolist()):
        placed = skin(mesh.vertices + moved[row], garment.skin_weights, pose_frame(shaped, poses, row).transforms)
        residual = np.full(len(placed), np.nan, np.float32)
        write_npz(stage.frame_path(frame_id), vertices=placed.astype(np.float32), residual_m=residual)
    stack_vertices(stage, poses.frame_ids.tolist())
    digest = stage.finish([stage.path / "vertices.npy"]).digest
    if maps:
        _write_maps(work / "wrinkles" / "generated", garment, poses.frame_ids.tolist(), maps, digest)
    return np.load(stage.path / "vertices.npy")


def _write_maps(folder: Path, garment: Garment, frame_ids: list[int], bits: int, digest: str) -> None:
    """A wave of its own for each frame, so that one cannot be taken for another."""
    config = {"bits": bits, "flip_green": False, "texels": None}
    stage = open_stage(folder, name="wrinkles apply", schema=2, config=config, upstream={"registration": digest})
    save_garment(folder / "template.npz", garment)
    across, down = np.meshgrid(np.linspace(0, 1, 64), np.linspace(0, 1, 64))
    for frame_id in frame_ids:
        x = 0.5 * np.sin(40 * across + frame_id)
        y = 0.2 * np.cos(25 * down)
        normal = np.stack([x, y, np.sqrt(1 - x**2 - y**2)], axis=2)
        levels = (2**bits - 1) / 2
        pixels = np.rint(levels * (normal + 1)).astype(np.uint16 if bits == 16 else np.uint8)
        write_bytes(stage.frame_path(frame_id, ".png"), cv2.imencode(".png", pixels[..., ::-1])[1].tobytes())
    stage.finish([stage.frame_path(frame_id, ".png") for frame_id in frame_ids])
