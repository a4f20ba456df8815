"""Every texel shows the surface point it should."""

import numpy as np
import pytest

from capture4d.errors import InputError
from capture4d.geometry.uv_raster import rasterise_uv, sample_bilinear
from capture4d.types import Mesh


def square(uv: list[tuple[float, float]]) -> Mesh:
    """Two triangles with these UVs at their four corners; the vertices are the UVs."""
    corners = np.array(uv, np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    vertices = np.column_stack([corners, np.zeros(4)]).astype(np.float32)
    return Mesh(vertices, faces, corners[faces])


SLANTED = square([(0.31, 0.22), (0.77, 0.35), (0.69, 0.8), (0.2, 0.6)])


def test_a_linear_function_is_reproduced_at_every_centre():
    raster = rasterise_uv(SLANTED, 64, padding=3)
    row, column = np.divmod(raster.texels[raster.inside], 64)
    centres = np.column_stack([(column + 0.5) / 64, 1 - (row + 0.5) / 64])
    shown = raster.at_vertices(SLANTED.vertices)[raster.inside]
    np.testing.assert_allclose(shown[:, :2], centres, atol=1e-6)


def test_inside_and_covered_agree_with_brute_force():
    size = 32
    raster = rasterise_uv(SLANTED, size, padding=2)
    polygon = SLANTED.vertices[:, :2].astype(float)

    def holds(points: np.ndarray) -> np.ndarray:
        edges = np.roll(polygon, -1, axis=0) - polygon
        return np.all(
            [edge[0] * (points[..., 1] - p[1]) - edge[1] * (points[..., 0] - p[0]) >= 0
             for p, edge in zip(polygon, edges, strict=True)],
            axis=0,
        )  # fmt: skip

    row, column = np.mgrid[:size, :size]
    centre = np.stack([(column + 0.5) / size, 1 - (row + 0.5) / size], axis=-1)
    np.testing.assert_array_equal(raster.image(raster.inside), holds(centre))
    fine = (np.arange(41) + 0.5) / 41 - 0.5
    offsets = np.stack(np.meshgrid(fine, fine), axis=-1).reshape(-1, 2) / size
    touched = holds(centre[:, :, None] + offsets).any(axis=2)
    covered = raster.image(raster.covered)
    assert not (touched & ~covered).any()
    assert (covered & ~touched).sum() <= 2  # corners that the samples miss


def test_padding_shows_the_nearest_point_and_reaches_as_far_as_told():
    raster = rasterise_uv(SLANTED, 64, padding=4)
    beside = ~raster.inside
    row, column = np.divmod(raster.texels[beside], 64)
    centres = np.column_stack([(column + 0.5) / 64, 1 - (row + 0.5) / 64])
    shown = raster.at_vertices(SLANTED.vertices)[beside][:, :2]
    distance = 64 * np.linalg.norm(shown - centres, axis=1)
    border = np.concatenate(
        [np.linspace(p, q, 4000) for p, q in zip(SLANTED.vertices, np.roll(SLANTED.vertices, -1, axis=0), strict=True)]
    )[:, :2]
    nearest = 64 * np.sqrt(((centres[:, None] - border[::8]) ** 2).sum(-1)).min(axis=1)
    np.testing.assert_allclose(distance, nearest, atol=0.02)
    assert distance.max() <= 4
    assert distance.max() > 3.5


def test_reading_an_image_is_the_inverse_of_drawing_it():
    raster = rasterise_uv(SLANTED, 40)
    values = np.random.default_rng(0).standard_normal((len(raster.texels), 3))
    np.testing.assert_array_equal(raster.read(raster.image(values)), values)


def test_bilinear_samples_are_exact_on_linear_images():
    size = 16
    row, column = np.mgrid[:size, :size]
    image = np.stack([(column + 0.5) / size, 1 - (row + 0.5) / size], axis=-1).astype(np.float32)
    uv = np.random.default_rng(0).uniform(0.5 / size, 1 - 0.5 / size, (200, 2))
    np.testing.assert_allclose(sample_bilinear(image, uv), uv, atol=1e-6)


@pytest.mark.parametrize(
    ("mesh", "said"),
    [
        (Mesh(SLANTED.vertices, SLANTED.faces), "expected UVs, found none"),
        (square([(0, 0), (2, 0), (2, 1), (0, 1)]), "unit square"),
        (
            Mesh(
                np.concatenate([SLANTED.vertices, SLANTED.vertices]),
                np.concatenate([SLANTED.faces, SLANTED.faces + 4]).astype(np.int32),
                np.concatenate([SLANTED.uv, SLANTED.uv]),  # pyright: ignore
            ),
            "used twice",
        ),
    ],
)
def test_uvs_that_make_no_map_are_named(mesh: Mesh, said: str):
    with pytest.raises(InputError, match=said):
        rasterise_uv(mesh, 64)
