"""Patterns in metres come to lie in the unit square: whole, apart, and at one scale."""

import itertools

import numpy as np
import pytest

from capture4d.errors import InputError
from capture4d.geometry.uv_layout import island_boxes, millimetres_per_texel, shelve, unit_square
from capture4d.geometry.uv_raster import rasterise_uv
from capture4d.types import Mesh


def panels(scale: float = 1.0) -> Mesh:
    """Four rectangles in the plane, in metres; their UVs are their places, times `scale`."""
    sizes = [(0.6, 0.7), (0.6, 0.7), (0.4, 0.25), (0.4, 0.25)]
    vertices, faces = [], []
    for index, (width, height) in enumerate(sizes):
        x, y = 0.7 * (index % 2), 0.8 * (index // 2)
        vertices += [(x, y, 0), (x + width, y, 0), (x + width, y + height, 0), (x, y + height, 0)]
        faces += [(4 * index, 4 * index + 1, 4 * index + 2), (4 * index, 4 * index + 2, 4 * index + 3)]
    corners, at = np.array(vertices, np.float32), np.array(faces, np.int32)
    return Mesh(corners, at, corners[at][..., :2] * np.float32(scale))


def test_a_pattern_in_metres_is_packed_at_one_scale_without_overlap():
    mesh = panels()
    packed = unit_square(mesh, gap=10 / 256)
    assert packed.uv is not None
    assert packed.uv.min() >= 0
    assert packed.uv.max() <= 1
    before = np.linalg.norm(mesh.uv[:, 1] - mesh.uv[:, 0], axis=1)
    after = np.linalg.norm(packed.uv[:, 1] - packed.uv[:, 0], axis=1)
    np.testing.assert_allclose(after / before, (after / before)[0], rtol=1e-4)
    raster = rasterise_uv(packed, 256, padding=4)
    # 10 texels between islands hold twice the padding and more: no padding is cut short
    expected = sum((w + 8) * (h + 8) - (4 - np.pi) * 16 for w, h in np.ptp(packed.uv[::2], axis=1) * 256)  # rounded
    assert expected * 0.9 < len(raster.texels) < expected * 1.1
    assert millimetres_per_texel(packed, 256) == pytest.approx(1e3 * (before / after)[0] / 256, rel=1e-3)


def test_uvs_in_the_unit_square_are_kept():
    mesh = panels(0.5)
    assert unit_square(mesh, gap=0.04) is mesh


@pytest.mark.parametrize(("scale", "layout"), [(3.0, "auto"), (1.0, "keep"), (-0.5, "auto")])
def test_other_uvs_are_refused(scale: float, layout: str):
    with pytest.raises(InputError, match="unit square"):
        unit_square(panels(scale), layout=layout, gap=0.04)  # pyright: ignore


def test_boxes_stand_on_shelves_apart_and_the_tall_ones_first():
    rng = np.random.default_rng(0)
    sizes = rng.uniform(0.05, 0.5, (40, 2))
    low = shelve(sizes, 1.2)
    high = low + sizes
    assert low.min() == 0.0
    assert high[:, 0].max() <= 1.2
    for one in range(40):
        for other in range(one):
            assert (low[one] >= high[other] - 1e-12).any() or (low[other] >= high[one] - 1e-12).any()
    levels = [sizes[low[:, 1] == level, 1] for level in np.unique(low[:, 1])]
    assert all(above.max() <= below.min() for below, above in itertools.pairwise(levels))
    np.testing.assert_array_equal(shelve(np.array([[3.0, 1.0], [2.0, 2.0]]), 1.0), [[0, 2], [0, 0]])


def test_a_box_holds_its_island():
    points = np.random.default_rng(1).standard_normal((30, 2))
    islands = np.arange(30) % 4
    low, high = island_boxes(points, islands)
    for island in range(4):
        np.testing.assert_array_equal(low[island], points[islands == island].min(axis=0))
        np.testing.assert_array_equal(high[island], points[islands == island].max(axis=0))
