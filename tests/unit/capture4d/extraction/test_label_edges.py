"""A strip of three colours that blend into each other, as the fused colours of a scan do."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import expit

from capture4d.colours.labels import classify_colours, settle_labels
from capture4d.extraction.label_edges import sharpen_labels
from capture4d.types import Mesh

STEP, WIDTH = 0.0027, 0.012
BLEND_M = 0.0008
"""Scale of the logistic function by which colours change."""
OUTFITS = [
    ((47, 98, 201), (255, 196, 0), (150, 152, 156)),
    ((186, 52, 58), (52, 178, 96), (92, 92, 100)),
]


def strip(outfit: tuple, rng: np.random.Generator) -> tuple[Mesh, np.ndarray, np.ndarray]:
    """Cloth below -WIDTH, paint up to 0, then the suit, under light that falls off; colours and their true shares."""
    y, x = (grid.ravel() for grid in np.meshgrid(np.arange(-0.05, 0.05, STEP), np.arange(0, 0.3, STEP), indexing="ij"))
    y = y + 0.3 * STEP * rng.standard_normal(len(y))
    columns = len(np.arange(0, 0.3, STEP))
    row, column = (index.ravel() for index in np.indices((len(y) // columns - 1, columns - 1)))
    a = row * columns + column
    b, c, d = a + 1, a + columns, a + columns + 1
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    cloth, suit = expit(-(y + WIDTH) / BLEND_M), expit(y / BLEND_M)
    shares = np.column_stack([suit, cloth, 1 - cloth - suit])
    colours = shares @ np.array([outfit[2], outfit[0], outfit[1]], float) * (1 - x)[:, None]
    colours = np.clip(colours + 3 * rng.standard_normal(colours.shape), 0, 255).astype(np.uint8)
    return Mesh(np.column_stack([x, y, 0 * x]).astype(np.float32), faces.astype(np.int32)), colours, shares


@pytest.mark.parametrize("outfit", OUTFITS)
@pytest.mark.parametrize("seed", [0, 1])
def test_edges_lie_where_colours_have_equal_shares(outfit: tuple, seed: int) -> None:
    mesh, colours, shares = strip(outfit, np.random.default_rng(seed))
    garment, paint, suit = outfit
    rough = settle_labels(mesh.faces, classify_colours(colours, garment, (paint,), others=(suit,)))
    sharp = sharpen_labels(mesh, colours, rough)
    truth = shares.argmax(axis=1)
    assert (sharp != truth).mean() < 0.01
    assert (sharp != truth).sum() < 0.5 * (rough != truth).sum()
    area = mesh.vertices[:, 0].max() * STEP / len(np.unique(mesh.vertices[:, 0]))
    width = (sharp == 2).sum() * area / mesh.vertices[:, 0].max()
    assert abs(width - WIDTH) < 0.0006


def test_one_label_and_labels_without_pure_vertices_stay() -> None:
    mesh, colours, _ = strip(OUTFITS[0], np.random.default_rng(2))
    plain = np.ones(len(colours), np.uint8)
    np.testing.assert_array_equal(sharpen_labels(mesh, colours, plain), plain)
    speck = plain.copy()
    speck[len(speck) // 2] = 2
    np.testing.assert_array_equal(sharpen_labels(mesh, colours, speck), speck)
