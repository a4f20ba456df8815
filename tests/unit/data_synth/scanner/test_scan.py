import dataclasses
import hashlib

import numpy as np
import pytest

from capture4d.errors import InputError
from capture4d.geometry.mesh import vertex_normals
from capture4d.geometry.ray_casting import TriangleScene
from capture4d.types import Mesh, Rig
from data_synth.scanner.config import FusionConfig, NoiseConfig, ScannerConfig, ShadingConfig
from data_synth.scanner.fusion import canonical_order, drop_small_components
from data_synth.scanner.raycast import NOTHING, Surface, SurfaceScene
from data_synth.scanner.rig import capture_rig, look_at
from data_synth.scanner.scan import LABEL_BORDER, LABEL_GARMENT, scan_surfaces
from tests.shapes import tube_faces

PERFECT = ScannerConfig(
    noise=NoiseConfig(sigma_m=0.0, silhouette_step_m=0.04, weak_loss=0.0, blob_loss=0.0),
    shading=ShadingConfig(ambient=1.0, camera_gain=0.0, pixel_noise=0.0),
    fusion=FusionConfig(min_component_faces=50),
)
RADIUS = 0.12


def swept(girth, height, around):
    """A surface of revolution about the Y axis through a profile, outward normals."""
    along = len(girth)
    angle = 2 * np.pi * np.arange(around) / around
    rings = girth[:, None] * np.sin(angle), height[:, None] + 0 * angle, girth[:, None] * np.cos(angle)
    vertices = np.stack(rings, axis=2).reshape(-1, 3)
    return Mesh(vertices.astype(np.float32), tube_faces(around, along))


def tube(length, *, radius=RADIUS, around=96, along=60):
    """An open tube about the origin."""
    return swept(np.full(along, radius), np.linspace(-length / 2, length / 2, along), around)


def sphere(radius=RADIUS, around=256, along=160):
    latitude = np.linspace(-np.pi / 2, np.pi / 2, along)
    return swept(radius * np.cos(latitude), radius * np.sin(latitude), around)


def painted(mesh, colour=(47, 98, 201), label=LABEL_GARMENT, voxel_m=0.004):
    return Surface(mesh, np.tile(np.array(colour, np.uint8), (len(mesh.vertices), 1)), label, voxel_m)


def scan(surfaces, config=PERFECT, *, cameras=16, size=160, seed=0):
    rig = capture_rig(centre=(0.0, 0.0, 0.0), radius=0.22, cameras=cameras, image_size=size)
    return scan_surfaces(rig, surfaces, config=config, rng=np.random.default_rng(seed))


def digest(result, labels):
    arrays = (result.mesh.vertices, result.mesh.faces, result.colours, labels)
    return hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()


def test_a_perfect_sensor_finds_the_surface_to_a_tenth_of_a_voxel():
    result, labels = scan([painted(sphere())])
    error = np.linalg.norm(result.mesh.vertices, axis=1) - RADIUS
    assert np.abs(error).mean() < 0.1 * 0.004
    assert abs(error.mean()) < 0.05 * 0.004
    assert (labels == LABEL_GARMENT).all()
    normals = vertex_normals(result.mesh.vertices, result.mesh.faces)
    assert (np.einsum("ij,ij->i", normals, result.mesh.vertices) > 0).mean() > 0.99


def test_half_a_pixel_of_shift_would_be_seen():
    """One camera before a slanted wall: a shift of half a pixel would move the wall by 0.35 pixels along its normal."""
    wall = np.array([[-1, -1, 1], [1, -1, -1], [1, 1, -1], [-1, 1, 1]], np.float32) * 0.2
    surface = painted(Mesh(wall, np.array([[0, 1, 2], [0, 2, 3]], np.int32)))
    rig = Rig(
        names=("front",),
        intrinsics=np.array([[[200.0, 0, 99.5], [0, 200.0, 79.5], [0, 0, 1]]]),
        distortion=np.zeros((1, 5)),
        T_camera_world=look_at((0.0, 0.0, 0.7), (0.0, 0.0, 0.0))[None],
        image_sizes=np.array([[200, 160]], np.int32),
    )
    config = dataclasses.replace(PERFECT, fusion=FusionConfig(min_weight=0.5))
    result, _ = scan_surfaces(rig, [surface], config=config, rng=np.random.default_rng(0))
    assert len(result.mesh.vertices) > 1000
    offset = result.mesh.vertices @ vertex_normals(wall, surface.mesh.faces)[0]
    assert abs(np.median(offset)) < 0.05 * 0.7 / 200


def test_error_falls_with_resolution():
    errors = []
    for voxel_m, size in ((0.008, 80), (0.004, 160), (0.002, 320)):
        result, _ = scan([painted(sphere(), voxel_m=voxel_m)], size=size)
        errors.append(np.abs(np.linalg.norm(result.mesh.vertices, axis=1) - RADIUS).mean())
    assert errors[1] < 0.7 * errors[0]
    assert errors[2] < 0.7 * errors[1]


def test_an_open_sheet_is_scanned_on_both_sides_without_interference():
    """An open tube of cloth: cameras above and below see its inside, one thickness behind the outside."""
    config = dataclasses.replace(PERFECT, fusion=FusionConfig(min_component_faces=50, inside=True, thickness_m=0.001))
    outside_only, _ = scan([painted(tube(0.2))], cameras=32)
    result, _ = scan([painted(tube(0.2))], config, cameras=32)
    normals = vertex_normals(result.mesh.vertices, result.mesh.faces)
    outward = np.einsum("ij,ij->i", normals[:, [0, 2]], result.mesh.vertices[:, [0, 2]]) > 0
    assert outward.sum() == len(outside_only.mesh.vertices)
    assert 0.05 < 1 - outward.mean() < 0.6
    error = np.hypot(result.mesh.vertices[:, 0], result.mesh.vertices[:, 2]) - np.where(outward, RADIUS, RADIUS - 0.001)
    assert np.quantile(np.abs(error[outward]), 0.95) < 0.2 * 0.004
    assert np.quantile(np.abs(error[~outward]), 0.95) < 0.25 * 0.004


@pytest.mark.parametrize("edge", [0.105, 0.03], ids=["a band", "most of the cloth"])
def test_the_painted_border_is_crisp_and_labelled(edge):
    mesh = tube(0.24, along=120)
    border = np.abs(mesh.vertices[:, 1]) > edge
    colours = np.where(border[:, None], (255, 210, 0), (47, 98, 201)).astype(np.uint8)
    config = dataclasses.replace(PERFECT, shading=ShadingConfig())
    result, labels = scan([Surface(mesh, colours, LABEL_GARMENT, 0.004, border)], config)
    truly_border = np.abs(result.mesh.vertices[:, 1]) > edge
    sure = np.abs(np.abs(result.mesh.vertices[:, 1]) - edge) > 0.004
    assert ((labels == LABEL_BORDER) == truly_border)[sure].all()
    yellow = result.colours[:, 0] > result.colours[:, 2]
    assert (yellow == truly_border)[sure].mean() > 0.999


def test_body_and_garment_keep_their_labels_and_voxels():
    body = painted(sphere(0.08), (120, 120, 120), label=0, voxel_m=0.006)
    result, labels = scan([body, painted(tube(0.08))])
    distance = np.hypot(result.mesh.vertices[:, 0], result.mesh.vertices[:, 2])
    assert (distance[labels == 1] > 0.11).all()
    assert (distance[labels == 0] < 0.09).all()
    assert (labels == 0).any()


def test_the_same_seed_gives_the_same_arrays_and_another_seed_does_not():
    surfaces = [painted(sphere(0.08), label=0), painted(tube(0.2))]
    noisy = dataclasses.replace(ScannerConfig(), fusion=PERFECT.fusion)
    first, second, other = (digest(*scan(surfaces, noisy, seed=seed)) for seed in (3, 3, 4))
    assert first == second
    assert first != other


def test_order_does_not_depend_on_the_order_of_extraction():
    result, _ = scan([painted(tube(0.2))], cameras=8)
    rng = np.random.default_rng(0)
    shuffle = rng.permutation(len(result.mesh.vertices))
    inverse = np.argsort(shuffle).astype(np.int32)
    faces = inverse[result.mesh.faces][rng.permutation(len(result.mesh.faces))]
    faces = np.roll(faces, 1, axis=1)
    expected = canonical_order(result.mesh.vertices, result.mesh.faces, result.colours)
    found = canonical_order(result.mesh.vertices[shuffle], faces, result.colours[shuffle])
    for a, b in zip(expected, found, strict=True):
        np.testing.assert_array_equal(a, b)


def test_small_pieces_are_dropped():
    big, small = tube(0.2, around=20, along=10), tube(0.1, radius=0.02, around=4, along=3)
    vertices = np.concatenate([small.vertices, big.vertices])
    faces = np.concatenate([small.faces, big.faces + np.int32(len(small.vertices))])
    colours = np.arange(len(vertices), dtype=np.uint8)[:, None].repeat(3, axis=1)
    kept, kept_faces, kept_colours = drop_small_components(vertices, faces, colours, 100)
    np.testing.assert_array_equal(kept, big.vertices)
    np.testing.assert_array_equal(kept_faces, big.faces)
    np.testing.assert_array_equal(kept_colours, colours[len(small.vertices) :])


def test_coarse_tiles_miss_nothing():
    """Against rays through every pixel of the image."""
    surfaces = [painted(tube(0.2)), painted(sphere(0.06), label=0)]
    scene = SurfaceScene(surfaces)
    triangles = TriangleScene(*((surface.mesh.vertices, surface.mesh.faces) for surface in surfaces))
    rig = capture_rig(centre=(0.0, 0.0, 0.0), radius=0.22, cameras=8, image_size=100)  # not a multiple of the tile
    for camera in range(8):
        images = scene.view(rig, camera)
        whole = np.full((100, 100), NOTHING, np.uint8)
        top, left = images.origin
        whole[top : top + images.surface.shape[0], left : left + images.surface.shape[1]] = images.surface
        rotation, pixels = rig.T_camera_world[camera, :3, :3], np.indices((100, 100))[::-1].reshape(2, -1)
        directions = np.linalg.inv(rig.intrinsics[camera]) @ np.vstack([pixels, np.ones(10_000)])
        rays = np.column_stack([np.tile(rig.centres[camera], (10_000, 1)), directions.T @ rotation])
        np.testing.assert_array_equal(whole != NOTHING, triangles.is_met(rays).reshape(100, 100))


def test_bad_input_is_named():
    rig = capture_rig(cameras=4, image_size=32)
    with pytest.raises(InputError, match="surfaces"):
        scan_surfaces(rig, [], config=PERFECT, rng=np.random.default_rng(0))
    bent = dataclasses.replace(rig, distortion=rig.distortion + 0.1)
    with pytest.raises(InputError, match="distortion"):
        scan_surfaces(bent, [painted(tube(0.1))], config=PERFECT, rng=np.random.default_rng(0))
