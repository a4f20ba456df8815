"""Maps on disk, across seams and with holes."""

import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest

from capture4d.errors import InputError
from capture4d.files.pictures import holds_pixels
from capture4d.geometry.islands.map_seams import seam_table
from capture4d.geometry.uv_raster import rasterise_uv
from capture4d.types import Garment, Mesh
from tests.unit.wrinkles.conftest import wrinkle_normals
from wrinkles.normal_maps.config import MapConfig
from wrinkles.normal_maps.display import fill_holes
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
    bare = rasterise_uv(template.mesh, 128)  # as a network paints it, which knows one side alone
    table = seam_table(template.mesh, bare)
    island = template.tangents.islands()[bare.faces]
    step = bare.image(np.where(island == 0, 1.0, 0.0)[:, None].astype(np.float32))
    blended = bare.read(table.blended(step, bare))[:, 0]
    points = bare.at_vertices(template.mesh.vertices.astype(float))
    at_seam = np.abs(points[:, 0]) < 1e-3
    assert np.abs(blended[at_seam] - 0.5).max() < 0.2
    far = np.abs(points[:, 0]) > 0.08
    np.testing.assert_array_equal(blended[far], (island == 0)[far])

    height = bare.image(points[:, 1:2].astype(np.float32))
    np.testing.assert_allclose(table.blended(height, bare), height, atol=2e-3)
    # and with the other side in the gutters, no step is left between one texel and the next
    along = np.abs(np.diff(template.across_seams(step)[..., 0], axis=1))
    inside = bare.image(bare.inside)
    assert along[inside[:, 1:] | inside[:, :-1]].max() < 0.3


def unrolled(points: np.ndarray) -> np.ndarray:
    """How far around the sleeve points lie, metres."""
    return 0.1 * np.arctan2(points[:, 0], points[:, 2])


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("size", [128, 300])
def test_a_gutter_shows_what_lies_across_the_seam(garment: Garment, mirrored: bool, size: int):
    """The panels are flat parts of one tube: beyond the seam the way around goes on by as much as the texels do."""
    mesh = garment.template
    assert mesh.uv is not None
    if mirrored:  # and the second panel is smaller
        second = mesh.uv[..., :1].mean(axis=1, keepdims=True) > 0.35
        turned = mesh.uv * np.array([-0.8, 0.8], np.float32) + np.array([1, 0], np.float32)
        mesh = Mesh(mesh.vertices, mesh.faces, np.where(second, turned, mesh.uv).astype(np.float32))
    template = MapTemplate.create(
        replace(garment, template=mesh), MapConfig(size=size, padding=size // 32, layout="pack")
    )
    bare, gutter = rasterise_uv(template.mesh, size, padding=size // 32), template.gutter
    assert not bare.inside[gutter.texels].any()
    border = bare.at_vertices(mesh.vertices.astype(float))[gutter.texels]
    across = template.raster.at_vertices(mesh.vertices.astype(float))[gutter.texels]
    row, column = np.divmod(bare.texels[gutter.texels], size)
    centres = np.stack([(column + 0.5) / size, 1 - (row + 0.5) / size], axis=1)
    texels = np.linalg.norm(centres - bare.at_corners(template.mesh.uv)[gutter.texels], axis=1)
    own = np.abs(np.linalg.det(np.diff(template.mesh.uv[bare.faces[gutter.texels]].astype(float), axis=1)))
    real = np.linalg.norm(
        np.cross(*np.moveaxis(np.diff(mesh.vertices[bare.corners[gutter.texels]], axis=1), 1, 0)), axis=1
    )
    metres = texels * np.sqrt(real / own)
    around = np.abs((unrolled(across) - unrolled(border) + 0.1 * np.pi) % (0.2 * np.pi) - 0.1 * np.pi)
    level = (border[:, 1] > 0.02) & (border[:, 1] < 0.48)  # where the seam ends, there is nothing to go on to
    assert level.sum() > 100
    np.testing.assert_allclose(around[level], metres[level], atol=2e-3)
    np.testing.assert_allclose(across[level, 1], border[level, 1], atol=2e-3)


def test_padding_beside_an_open_border_repeats_it(garment: Garment):
    template = MapTemplate.create(garment, MapConfig(size=128))
    bare = rasterise_uv(template.mesh, 128)
    rest = np.setdiff1d(np.flatnonzero(~bare.inside), template.gutter.texels)
    height = bare.at_vertices(garment.template.vertices.astype(float))[rest, 1]
    assert np.minimum(height, 0.5 - height).max() < 0.02
    np.testing.assert_array_equal(template.raster.barycentric[rest], bare.barycentric[rest])


def test_a_gutter_goes_on_in_the_island_s_own_tangent_space(garment: Garment):
    """Waves along the sleeve have one slope on either side of a seam; so a renderer that reads the gutter sees no step,
    though the second panel is turned by a quarter."""
    mesh = garment.template
    assert mesh.uv is not None
    second = mesh.uv[..., :1].mean(axis=1, keepdims=True) > 0.35
    turned = mesh.uv[..., ::-1] * np.array([-1, 1], np.float32) + np.array([2, 0], np.float32)
    mesh = Mesh(mesh.vertices, mesh.faces, np.where(second, turned, mesh.uv).astype(np.float32))
    template = MapTemplate.create(replace(garment, template=mesh), MapConfig(size=128, layout="pack"))
    points = template.raster.at_vertices(mesh.vertices.astype(float))
    image = template.tangent_image(wrinkle_normals(points).astype(np.float32), mesh.vertices)
    slope = np.hypot(*np.moveaxis(template.raster.read(image)[:, :2], 1, 0))
    angle = np.degrees(np.arctan2(*np.moveaxis(template.raster.read(image)[:, 1::-1], 1, 0)))
    island = template.tangents.islands()[rasterise_uv(template.mesh, 128).faces]
    for number in (0, 1):
        inner = (island == number) & template.raster.inside & (slope > 0.1)
        outer = template.gutter.texels[(island == number)[template.gutter.texels]]
        outer = outer[slope[outer] > 0.1]
        lies = np.abs(angle[inner]) % 180  # 90 where waves run along v, 0 or 180 where along u
        assert np.ptp(np.minimum(lies, 180 - lies)) < 12  # facets of the tube
        goes_on = np.abs(angle[outer]) % 180
        assert len(outer) > 50
        assert abs(np.median(np.minimum(goes_on, 180 - goes_on)) - np.median(np.minimum(lies, 180 - lies))) < 4


def test_a_seam_moves_nothing_on_an_island_beside_it(garment: Garment):
    """The first panel's hem, an open edge, lies two texels above a seam of the second."""
    mesh = garment.template
    assert mesh.uv is not None
    second = mesh.uv[..., 0].mean(axis=1, keepdims=True) > 0.35
    u, v = 0.9 * mesh.uv[..., 0], 0.9 * mesh.uv[..., 1]
    beside = np.stack([0.02 + v, 0.5 - 2.5 / 128 - (u - 0.9 * (0.1 * np.pi + 0.1))], axis=-1)  # turned by 90 degrees
    uv = np.where(second[..., None], beside, np.stack([0.02 + u, 0.5 + v], axis=-1)).astype(np.float32)
    template = MapTemplate.create(replace(garment, template=Mesh(mesh.vertices, mesh.faces, uv)), MapConfig(size=128))
    bare = rasterise_uv(template.mesh, 128)
    island = template.tangents.islands()[bare.faces]
    first = ~second.ravel()[bare.faces]
    assert len(np.unique(island[first])) == 1
    points = bare.at_vertices(mesh.vertices.astype(float))
    hem = first & (points[:, 1] < 0.03) & (np.abs(points[:, 0]) > 0.08)
    assert hem.sum() > 50
    step = bare.image(np.where(first, 1.0, 0.0)[:, None].astype(np.float32))
    np.testing.assert_array_equal(bare.read(template.seams.blended(step, bare))[hem], 1)


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
