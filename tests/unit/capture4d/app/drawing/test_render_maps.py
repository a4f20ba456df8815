"""The proof of conventions: a dome in a normal map, lit, looks like a dome."""

import numpy as np
import pytest

from capture4d.app.drawing.render import Drawn, View, render
from capture4d.types import Mesh

SIZE = 128
FRONT = View((0.0, 0.0, 0.0), azimuth_deg=0.0, elevation_deg=0.0, height_m=1.1)


def dome_map() -> np.ndarray:
    """Tangent-space normals of a dome that rises out of a plate; +Y is up, row 0 is the top."""
    row, column = np.mgrid[:SIZE, :SIZE]
    x, y = 2 * (column + 0.5) / SIZE - 1, 1 - 2 * (row + 0.5) / SIZE
    inside = np.hypot(x, y) < 0.7
    normal = np.stack([x * inside, y * inside, np.ones_like(x)], axis=-1)
    normal[..., 2] = np.where(inside, np.sqrt(np.maximum(1 - x**2 - y**2, 0)), 1)
    return (normal / np.linalg.norm(normal, axis=-1, keepdims=True)).astype(np.float32)


def plate(uv: list[tuple[float, float]]) -> Mesh:
    """A square that faces +Z, its corners counter-clockwise from the lower left."""
    corners = np.array([(-0.5, -0.5, 0), (0.5, -0.5, 0), (0.5, 0.5, 0), (-0.5, 0.5, 0)], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return Mesh(corners, faces, np.array(uv, np.float32)[faces])


UPRIGHT = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]


def real_dome() -> Mesh:
    """The same dome as geometry, on a fine grid."""
    x, y = np.meshgrid(np.linspace(-1, 1, 201), np.linspace(-1, 1, 201))
    z = np.where(np.hypot(x, y) < 0.7, np.sqrt(np.maximum(1 - x**2 - y**2, 0)), np.sqrt(1 - 0.49))
    index = np.arange(201 * 201).reshape(201, 201)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3).astype(np.int32)
    return Mesh((np.stack([x, y, z], axis=-1).reshape(-1, 3) / 2).astype(np.float32), faces)


def drawn(mesh: Mesh, normal_map: np.ndarray | None = None) -> np.ndarray:
    return render([Drawn(mesh, normal_map=normal_map)], FRONT, width=160, height=160).astype(int)


def test_a_dome_in_a_map_is_lit_like_a_dome_of_geometry():
    painted, real = drawn(plate(UPRIGHT), dome_map()), drawn(real_dome())
    yy, xx = np.mgrid[:160, :160]
    radius = np.hypot(xx - 79.5, yy - 79.5) / 160 * 1.1 * 2
    away_from_the_rim = (radius < 0.6) | ((radius > 0.8) & (radius < 0.9))
    assert np.abs(painted - real)[away_from_the_rim].mean() < 2.5
    # key light from above on the left: the dome is bright there, and a map with green flipped is not
    flipped = drawn(plate(UPRIGHT), dome_map() * np.array([1, -1, 1], np.float32))
    assert painted[45:60, 55:70].mean() > painted[100:115, 90:105].mean() + 30
    assert np.abs(flipped - real)[away_from_the_rim].mean() > 10


def test_a_map_that_leans_past_the_outline_does_not_turn_a_surface_over():
    """Seen from the front, light changes by little between normals just before and just past the outline."""
    levels = []
    for degrees in (88.0, 92.0):
        leaning = np.zeros((SIZE, SIZE, 3), np.float32)
        leaning[..., 1], leaning[..., 2] = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
        levels.append(drawn(plate(UPRIGHT), leaning)[60:100, 60:100].mean())
    assert abs(levels[0] - levels[1]) < 6


@pytest.mark.parametrize(
    "uv",
    [[(0.0, 1.0), (0.0, 0.0), (1.0, 0.0), (1.0, 1.0)], [(1.0, 0.0), (0.0, 0.0), (0.0, 1.0), (1.0, 1.0)]],
    ids=["quarter turn", "mirrored"],
)
def test_turned_and_mirrored_islands_show_the_same_dome(uv: list[tuple[float, float]]):
    """A dome looks the same however its island lies in the map, if the frames follow the UVs."""
    np.testing.assert_allclose(drawn(plate(uv), dome_map()), drawn(plate(UPRIGHT), dome_map()), atol=3)


def test_a_flat_map_changes_nothing():
    flat = np.zeros((8, 8, 3), np.float32)
    flat[..., 2] = 1
    mesh = real_dome()
    mapped = Mesh(mesh.vertices, mesh.faces, (mesh.vertices[mesh.faces][..., :2] + np.float32(0.5)).clip(0, 1))
    assert np.abs(drawn(mapped, flat) - drawn(mesh)).max() <= 1
