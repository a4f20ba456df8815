"""Patterns in metres come to lie in the unit square: whole, apart, and at one scale."""

import numpy as np
import pytest

from capture4d.errors import InputError
from capture4d.geometry.uv_layout import millimetres_per_texel, unit_square
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
