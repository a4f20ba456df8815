"""A floor is what a thing stands on, whichever way up; a thing's own flat sides are not."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.types import Mesh
from registration.config import MeshRegistrationConfig
from registration.floor import find_floor
from registration.register_mesh import register_mesh


def sheet(side: float, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A square at y = 0 that looks up, with 1 mm of noise."""
    at = np.linspace(-side / 2, side / 2, count)
    x, z = np.meshgrid(at, at, indexing="ij")
    vertices = np.column_stack([x.ravel(), 0.001 * rng.standard_normal(count**2), z.ravel()])
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    square = np.column_stack([corner, corner + 1, corner + count + 1, corner + count])
    return vertices, np.concatenate([square[:, :3], square[:, [0, 2, 3]]]).astype(np.int32)


def on_floor(mesh: Mesh, side: float) -> tuple[Mesh, np.ndarray]:
    """The mesh 2 cm above a floor, and which vertices are the floor's."""
    vertices, faces = sheet(side, 80, np.random.default_rng(0))
    lifted = mesh.vertices - [0.0, mesh.vertices[:, 1].min() - 0.02, 0.0]
    joined = np.concatenate([lifted, vertices]).astype(np.float32)
    return Mesh(joined, np.concatenate([mesh.faces, faces + len(lifted)])), np.arange(len(joined)) >= len(lifted)


@pytest.mark.parametrize("turn_deg", [(0, 0, 0), (40, 110, -75)])
def test_a_floor_is_found_whole_and_alone(turn_deg, tube) -> None:
    scene, truth = on_floor(tube(80, 60), 0.9)
    turn = Rotation.from_euler("xyz", turn_deg, degrees=True).as_matrix()
    found = find_floor(scene.vertices.astype(float) @ turn.T, scene.faces)
    assert found is not None
    assert (found == truth).mean() > 0.999


def test_what_ends_under_the_thing_is_its_own(tube) -> None:
    scene, _ = on_floor(tube(80, 60), 0.2)  # the bottom of a cup
    assert find_floor(scene.vertices.astype(float), scene.faces) is None
    assert find_floor(*sheet(1.0, 60, np.random.default_rng(1))) is None  # nothing but a plane
    assert find_floor(tube(80, 60).vertices.astype(float), tube(80, 60).faces) is None


def test_a_scan_is_registered_as_if_there_were_no_floor(garment, scan_of) -> None:
    scan = scan_of(lambda points: points * [1.03, 1.0, 0.98], around=80, along=60).mesh
    scene, _ = on_floor(scan, 0.9)
    lift = 0.02 - scan.vertices[:, 1].min()
    config = replace(MeshRegistrationConfig(), align="none", lengths="kept")
    plain = register_mesh(garment.template, scan, config=config)
    template = garment.template.with_vertices(garment.template.vertices + np.float32([0.0, lift, 0.0]))
    floored = register_mesh(template, scene, config=config)
    assert floored.floor_percent > 20.0
    assert floored.quality.verdict == plain.quality.verdict != "failed"
    off = floored.vertices - np.float32([0.0, lift, 0.0]) - plain.vertices
    assert np.abs(off).max() < 0.002
