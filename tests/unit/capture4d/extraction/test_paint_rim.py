"""Where paint begins, between samples of a scan whose colours blend there."""

import numpy as np
import pytest

from capture4d.extraction.garment import painted_border
from capture4d.extraction.paint_rim import inner_rim
from capture4d.types import Mesh
from tests.shapes import tube

CLOTH, PAINT = np.array((47.0, 98.0, 201.0)), np.array((255.0, 196.0, 0.0))
HEIGHT, SPACING = 0.3, 0.004


def blended(begins: float, cloth: np.ndarray = CLOTH) -> tuple[Mesh, np.ndarray, np.ndarray]:
    """A tube whose paint begins at a height; over a spacing to both sides colours blend. Mesh, colours, paint share."""
    mesh = tube(160, 76, 0.1, HEIGHT)
    share = np.clip(0.5 + (mesh.vertices[:, 1:2] - begins) / (2 * SPACING), 0.0, 1.0)
    return mesh, ((1 - share) * cloth + share * PAINT).astype(np.uint8), share[:, 0]


@pytest.mark.parametrize("begins", [0.2802, 0.2811, 0.2823, 0.2837])
def test_the_rim_is_found_between_samples(begins: float) -> None:
    mesh, colours, share = blended(begins)
    rim = inner_rim(mesh, colours, share > 0.2)  # labels that take blends for paint widen it
    assert len(rim) >= 160
    np.testing.assert_allclose(rim[:, 1], begins, atol=0.15 * SPACING)


def test_cloth_or_paint_alone_has_no_rim() -> None:
    mesh, colours, share = blended(0.28)
    for nothing in (share < 0.0, share >= 0.0):
        assert inner_rim(mesh, colours, nothing).shape == (0, 3)


def test_paint_is_told_from_cloth_of_a_like_colour() -> None:
    mesh, colours, _ = blended(0.282, cloth=np.array((255.0, 120.0, 0.0)))
    points, rim = painted_border(mesh, colours, (255, 196, 0))
    assert len(points) > 100
    assert abs(points[:, 1].mean() - HEIGHT) < SPACING
    np.testing.assert_allclose(rim[:, 1], 0.282, atol=0.1 * SPACING)
