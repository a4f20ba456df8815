"""A small open tube and its scans: cloth enough for every law, quick enough for every run."""

from collections.abc import Callable

import numpy as np
import pytest

from capture4d.geometry.mesh import boundary_loops
from capture4d.types import Garment, GarmentScan, Mesh
from registration.config import (
    BoundaryConfig,
    CoarseConfig,
    DataConfig,
    DenseConfig,
    GraphConfig,
    LinearSolverConfig,
    RegistrationConfig,
    Schedule,
)
from tests.shapes import tube_faces


def oval_tube(around: int, along: int) -> Mesh:
    """An open tube about Y with an uneven oval section, 0.3 m across and 0.5 m high, wound outwards."""
    angle = 2 * np.pi * np.arange(around) / around
    radius = 0.15 + 0.03 * np.cos(2 * angle) + 0.015 * np.cos(3 * angle + 1)
    ring = np.stack([radius * np.sin(angle), radius * np.cos(angle)], axis=1)
    heights = np.linspace(0, 0.5, along)
    vertices = np.concatenate([np.column_stack([ring[:, 0], np.full(around, y), ring[:, 1]]) for y in heights])
    return Mesh(vertices.astype(np.float32), tube_faces(around, along))


@pytest.fixture
def tube() -> Callable[[int, int], Mesh]:
    return oval_tube


@pytest.fixture
def garment() -> Garment:
    mesh = oval_tube(36, 18)
    low, high = sorted(boundary_loops(mesh.faces), key=lambda loop: mesh.vertices[loop, 1].mean())
    return Garment(mesh, {"hem": low, "neck": high})


@pytest.fixture
def scan_of() -> Callable[..., GarmentScan]:
    def make(
        warp: Callable[[np.ndarray], np.ndarray], *, around: int = 160, along: int = 80, noise: float = 0.0
    ) -> GarmentScan:
        """A finer tube, warped, with its two borders known."""
        mesh = oval_tube(around, along)
        points = warp(mesh.vertices.astype(np.float64))
        points += noise * np.random.default_rng(0).standard_normal(points.shape)
        moved = mesh.with_vertices(points.astype(np.float32))
        low, high = sorted(boundary_loops(mesh.faces), key=lambda loop: mesh.vertices[loop, 1].mean())
        loops = np.repeat(np.array([0, 1], np.int32), [len(low), len(high)])
        return GarmentScan(moved, moved.vertices[np.concatenate([low, high])], loops, ("hem", "neck"), 7)

    return make


@pytest.fixture
def config() -> RegistrationConfig:
    """The default, on a graph that suits the tube."""
    return RegistrationConfig(graph=GraphConfig(nodes=40, vertices=0))


@pytest.fixture
def exact() -> RegistrationConfig:
    """Weights that leave a rigid motion alone, and enough steps to reach it."""
    steps = Schedule(25, (0.2, 0.05), rigid=(10.0, 10.0), smooth=(10.0, 10.0))
    dense = Schedule(6, (0.02, 0.01), smooth=(0.1, 0.1), stretch=(1.0, 1.0), boundary=(0.1, 0.1))
    return RegistrationConfig(
        solver=LinearSolverConfig(tolerance=1e-6, max_iterations=500),
        data=DataConfig(smoothing_passes=0),
        boundary=BoundaryConfig(coarse_rule="nearest", dense_rule="nearest"),
        graph=GraphConfig(nodes=40, vertices=0),
        coarse=CoarseConfig(cold=steps),
        dense=DenseConfig(cold=dense, fold_lengths=False),
    )
