"""Maps on disk, across seams and with holes."""

import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest

from capture4d.errors import InputError
from capture4d.files.pictures import holds_pixels
from capture4d.types import Garment, Mesh
from wrinkles.normal_maps.config import MapConfig
from wrinkles.normal_maps.display import fill_holes
from wrinkles.normal_maps.seams import seam_table
from wrinkles.normal_maps.spaces import decode_png, encode_png, flip_green
from wrinkles.normal_maps.template import MapTemplate


def some_normals(size: int = 24) -> np.ndarray:
    normals = np.random.default_rng(0).standard_normal((size, size, 3))
    return (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype(np.float32)


def test_a_png_keeps_normals_to_a_thousandth_of_a_degree_and_the_mask():
    normals, valid = some_normals(), np.random.default_rng(1).random((24, 24)) > 0.5
    image, mask = decode_png(encode_png(normals, valid), source="x.png")
    assert np.degrees(np.linalg.norm(image - normals, axis=-1)).max() < 3e-3
    np.testing.assert_array_equal(mask, valid)
    assert decode_png(encode_png(normals), source="x.png")[1].all()


def test_red_is_x_in_the_file():
    from io import BytesIO

    import cv2

    image = np.zeros((2, 2, 3), np.float32)
    image[..., 0] = 1
    pixels = cv2.imdecode(np.frombuffer(BytesIO(encode_png(image)).getvalue(), np.uint8), cv2.IMREAD_UNCHANGED)
    assert pixels[0, 0].tolist() == [32768, 32768, 65535]  # OpenCV's order is blue, green, red


@pytest.mark.parametrize("data", [b"", b"not a png", encode_png(some_normals())[:200]])
def test_a_damaged_png_is_named(data: bytes):
    with pytest.raises(InputError, match=r"x\.png: expected a 16-bit"):
        decode_png(data, source="x.png")


def test_green_flipped_twice_is_as_before():
    normals = some_normals()
    np.testing.assert_array_equal(flip_green(flip_green(normals)), normals)
    np.testing.assert_array_equal(flip_green(normals)[..., 1], -normals[..., 1])


def test_a_step_at_a_seam_vanishes_and_continuous_maps_stay(garment: Garment):
    template = MapTemplate.create(garment, MapConfig(size=128))
    table = seam_table(template.mesh, template.raster)
    island = template.tangents.islands()[template.raster.faces]
    step = template.raster.image(np.where(island == 0, 1.0, 0.0)[:, None].astype(np.float32))
    blended = template.raster.read(table.blended(step, template.raster))[:, 0]
    points = template.raster.at_vertices(template.mesh.vertices.astype(float))
    at_seam = np.abs(points[:, 0]) < 1e-3
    assert np.abs(blended[at_seam] - 0.5).max() < 0.2
    far = np.abs(points[:, 0]) > 0.08
    np.testing.assert_array_equal(blended[far], (island == 0)[far])

    height = template.raster.image(points[:, 1:2].astype(np.float32))
    np.testing.assert_allclose(table.blended(height, template.raster), height, atol=2e-3)


def test_a_seam_moves_nothing_on_an_island_beside_it(garment: Garment):
    """The first panel's hem, an open edge, lies two texels above a seam of the second."""
    mesh = garment.template
    assert mesh.uv is not None
    second = mesh.uv[..., 0].mean(axis=1, keepdims=True) > 0.35
    u, v = 0.9 * mesh.uv[..., 0], 0.9 * mesh.uv[..., 1]
    beside = np.stack([0.02 + v, 0.5 - 2.5 / 128 - (u - 0.9 * (0.1 * np.pi + 0.1))], axis=-1)  # turned by 90 degrees
    uv = np.where(second[..., None], beside, np.stack([0.02 + u, 0.5 + v], axis=-1)).astype(np.float32)
    template = MapTemplate.create(replace(garment, template=Mesh(mesh.vertices, mesh.faces, uv)), MapConfig(size=128))
    table = seam_table(template.mesh, template.raster)
    island = template.tangents.islands()[template.raster.faces]
    first = ~second.ravel()[template.raster.faces]
    assert len(np.unique(island[first])) == 1
    points = template.raster.at_vertices(mesh.vertices.astype(float))
    hem = first & (points[:, 1] < 0.03) & (np.abs(points[:, 0]) > 0.08)
    assert hem.sum() > 50
    step = template.raster.image(np.where(first, 1.0, 0.0)[:, None].astype(np.float32))
    np.testing.assert_array_equal(template.raster.read(table.blended(step, template.raster))[hem], 1)


def test_holes_are_filled_from_around_and_nothing_else_changes():
    row, column = np.mgrid[:64, :64].astype(np.float32) / 64
    image = np.stack([row, column, np.ones_like(row)], axis=-1)
    valid = np.hypot(row - 0.5, column - 0.5) > 0.15
    filled = fill_holes(image, valid)
    np.testing.assert_allclose(filled[valid], image[valid], atol=1e-6)
    assert np.abs(filled - image)[~valid].max() < 0.15
    assert np.ptp(filled[~valid][:, 2]) < 1e-5
    assert not fill_holes(image, np.zeros_like(valid)).any()


def test_a_png_that_claims_more_than_it_holds_is_not_decoded():
    """OpenCV makes room for the pixels first: up to 8 GB."""
    data = bytearray(encode_png(np.zeros((4, 4, 3), np.float32)))
    data[16:24] = struct.pack(">II", 10_000, 10_000)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    with pytest.raises(InputError, match="one that is damaged"):
        decode_png(bytes(data), source="x.png")
    assert not holds_pixels(bytes(data))
    long = bytearray(encode_png(np.zeros((4, 4, 3), np.float32)))
    long[33:37] = struct.pack(">I", 2**31 - 1)
    assert not holds_pixels(bytes(long)), "a part of 2 GB"
    assert holds_pixels(encode_png(np.zeros((3000, 3000, 3), np.float32)))
