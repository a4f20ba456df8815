"""A painted strip of cloth whose outer half bends to the body behind it: the border is where the cloth would end."""

from __future__ import annotations

import numpy as np
import pytest

from capture4d.extraction.band_borders import border_beyond_rim
from capture4d.types import Mesh

STEP, WIDTH, LENGTH, CLOTH, BODY = 0.0022, 0.012, 0.3, 0.06, 0.02


def bent_strip(rng: np.random.Generator, *, bend_m: float, holes: int = 0) -> tuple[Mesh, np.ndarray, np.ndarray]:
    """Cloth in the plane z = 0 above its border at y = 0; the paint's outer 4 mm curve away by up to `bend_m`.

    Returns the mesh, which goes on below the border, and which of its vertices are cloth and paint.
    """
    across, along = np.arange(-WIDTH - CLOTH, BODY, STEP) + rng.uniform(0, STEP) * 0.2, np.arange(0, LENGTH, STEP)
    y, x = (grid.ravel() for grid in np.meshgrid(across, along, indexing="ij"))
    x, y = (values + 0.15 * STEP * rng.standard_normal(len(values)) for values in (x, y))
    tail = np.clip((y + 0.004) / 0.004, 0, 1)
    z = -bend_m * tail * (0.5 + 0.5 * np.sin(40 * x)) + 0.0002 * rng.standard_normal(len(x))
    row, column = (index.ravel() for index in np.indices((len(across) - 1, len(along) - 1)))
    a = row * len(along) + column
    b, c, d = a + 1, a + len(along), a + len(along) + 1
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    vertices = np.column_stack([x, y, z])
    keep = np.ones(len(faces), bool)
    for _ in range(holes):
        centre = [rng.uniform(0, LENGTH), rng.uniform(-0.006, 0), 0]
        keep &= np.linalg.norm(vertices[faces].mean(axis=1) - centre, axis=1) > 0.005
    return Mesh(vertices.astype(np.float32), faces[keep].astype(np.int32)), y <= -WIDTH, (y > -WIDTH) & (y <= 0)


@pytest.mark.parametrize(("bend_m", "holes"), [(0.0, 0), (0.004, 0), (0.004, 6)])
@pytest.mark.parametrize("seed", [0, 1])
def test_the_border_is_carried_on_from_the_inner_rim(bend_m: float, holes: int, seed: int) -> None:
    mesh, cloth, painted = bent_strip(np.random.default_rng(seed), bend_m=bend_m, holes=holes)
    border = border_beyond_rim(mesh, cloth, painted)
    inside = border[(border[:, 0] > 0.01) & (border[:, 0] < LENGTH - 0.01)]
    assert len(inside) > 150
    assert np.percentile(np.abs(inside[:, 2]), 95) < 0.001
    assert abs(np.median(inside[:, 1])) < 0.0005
    gaps = np.diff(np.sort(inside[:, 0]))
    assert gaps.max() < 0.01  # also behind holes


def test_where_the_band_is_curled_nothing_is_said() -> None:
    """There the border is neither where the cloth above points to, nor where the band does."""
    mesh, cloth, painted = bent_strip(np.random.default_rng(5), bend_m=0.0)
    vertices = mesh.vertices.copy()
    curled = (vertices[:, 0] > 0.12) & (vertices[:, 0] < 0.18) & (vertices[:, 1] > -WIDTH)
    angle = (vertices[curled, 1] + WIDTH) / 0.005
    vertices[curled, 1:] = np.column_stack([0.005 * np.sin(angle) - WIDTH, 0.005 * (1 - np.cos(angle))])
    border = border_beyond_rim(Mesh(vertices, mesh.faces), cloth, painted)
    assert not ((border[:, 0] > 0.135) & (border[:, 0] < 0.165)).any()
    for flat in (border[border[:, 0] < 0.1], border[border[:, 0] > 0.2]):
        assert len(flat) > 40
        assert np.abs(flat[:, 1:]).max() < 0.002


def test_the_border_moves_with_the_strip() -> None:
    rng = np.random.default_rng(3)
    mesh, cloth, painted = bent_strip(rng, bend_m=0.003)
    turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    moved = Mesh((mesh.vertices @ turn.T + [0.3, -0.2, 1.0]).astype(np.float32), mesh.faces)
    expected = border_beyond_rim(mesh, cloth, painted) @ turn.T + [0.3, -0.2, 1.0]
    np.testing.assert_allclose(border_beyond_rim(moved, cloth, painted), expected, atol=2e-5)


def test_a_patch_of_paint_is_no_border_and_neither_is_nothing() -> None:
    mesh, cloth, painted = bent_strip(np.random.default_rng(4), bend_m=0.0)
    patch = np.linalg.norm(mesh.vertices - [0.15, -0.045, 0], axis=1) < 0.005
    border = border_beyond_rim(mesh, cloth & ~patch, painted | patch)
    assert border[:, 1].min() > -0.005
    nothing = np.zeros(len(painted), bool)
    assert border_beyond_rim(mesh, ~nothing, nothing).shape == (0, 3)
