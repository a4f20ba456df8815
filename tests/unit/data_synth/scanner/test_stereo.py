"""Active stereo against geometry: rectified pods, shadows where rays say so, depths of known surfaces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from capture4d.types import Mesh, Rig
from data_synth.scanner.config import FusionConfig, ScannerConfig, StereoConfig
from data_synth.scanner.raycast import Surface, SurfaceScene
from data_synth.scanner.rig import look_at, pod_rig
from data_synth.scanner.scan import LABEL_BODY, LABEL_BORDER, LABEL_GARMENT, scan_surfaces
from data_synth.scanner.stereo import SpecklePair, match_pair, speckle_pair

POD = StereoConfig(pods=4, image_size=320, supersampling=1, speckle_window_px=60)
WHITE = (200, 200, 200)


def plate(z: float, half: float, *, x: float = 0.0, y: float = 0.0) -> Surface:
    """A square that faces +Z."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32) * half + np.float32([x, y, z])
    mesh = Mesh(corners.astype(np.float32), np.array([[0, 1, 2], [0, 2, 3]], np.int32))
    return Surface(mesh, np.tile(np.array(WHITE, np.uint8), (4, 1)), LABEL_GARMENT, 0.005)


def sphere(radius: float, colour: tuple[int, int, int], label: int, *, band: float = 0.0) -> Surface:
    """About the origin; the southern end of a garment is cut off at `band` above its lower quarter and painted."""
    latitude, longitude = np.meshgrid(
        np.linspace(-np.pi / 2, np.pi / 2, 90), np.arange(120) * np.pi / 60, indexing="ij"
    )
    vertices = radius * np.stack(
        np.broadcast_arrays(
            np.cos(latitude) * np.sin(longitude), np.sin(latitude), np.cos(latitude) * np.cos(longitude)
        ),
        axis=-1,
    ).reshape(-1, 3)
    row, column = np.divmod(np.arange(89 * 120), 120)
    a, b = row * 120 + column, row * 120 + (column + 1) % 120
    faces = np.concatenate([np.stack([a, b, b + 120], 1), np.stack([a, b + 120, a + 120], 1)])
    painted = (vertices[:, 1] < -radius / 2 + band) & (band > 0)
    colours = np.where(painted[:, None], (255, 196, 0), colour).astype(np.uint8)
    if band:
        faces = faces[(vertices[faces, 1] >= -radius / 2).all(axis=1)]
    return Surface(Mesh(vertices.astype(np.float32), faces.astype(np.int32)), colours, label, 0.005, painted)


def front_pod(distance: float) -> Rig:
    """One pod at (0, 0, distance) that looks at the origin."""
    rig = pod_rig(centre=(0.0, 0.0, 0.0), radius=0.5, config=POD)
    eye = look_at((0.0, 0.0, distance), (0.0, 0.0, 0.0))
    transforms = np.stack([eye, eye])
    transforms[:, 0, 3] -= np.array([-0.1, 0.1])
    middle, focal = (POD.image_size - 1) / 2, rig.intrinsics[0, 0, 0]
    intrinsics = rig.intrinsics[:2].copy()
    intrinsics[:, 0, 2] = middle + focal * np.array([-0.1, 0.1]) / distance
    return Rig(rig.names[:2], intrinsics, rig.distortion[:2], transforms, rig.image_sizes[:2])


def grey(pair: SpecklePair) -> np.ndarray:
    """Of one colour, so that it guides nothing."""
    return np.full((*pair.left.shape, 3), 0.5, np.float32)


def true_depth(rig: Rig, surfaces: list[Surface]) -> np.ndarray:
    images = SurfaceScene(surfaces).view(rig, 0)
    assert images is not None
    whole = np.zeros((POD.image_size, POD.image_size), np.float32)
    whole[images.window] = images.depth
    return whole


@pytest.mark.parametrize("seed", [0, 1])
def test_pods_are_rectified_and_meet_at_the_subject(seed: int) -> None:
    rng = np.random.default_rng(seed)
    centre = rng.normal(size=3)
    rig = pod_rig(centre=centre, radius=0.6, config=POD)
    assert len(rig.names) == 2 * POD.pods
    points = centre + 0.4 * rng.uniform(-1, 1, (50, 3))
    for left in range(0, len(rig.names), 2):
        assert np.linalg.norm(rig.centres[left + 1] - rig.centres[left]) == pytest.approx(POD.baseline_m)
        pixels = []
        for camera in (left, left + 1):
            seen = rig.T_camera_world[camera] @ np.column_stack([np.vstack([points, centre]), np.ones(51)]).T
            image = rig.intrinsics[camera] @ seen[:3]
            pixels.append(image[:2] / image[2])
        np.testing.assert_allclose(pixels[0][1], pixels[1][1], atol=1e-9)  # rows correspond
        forward = rig.T_camera_world[left, 2, :3]
        eye = (rig.centres[left] + rig.centres[left + 1]) / 2
        target = eye + forward * np.linalg.norm(centre - eye)
        at_target = [
            rig.intrinsics[camera] @ (rig.T_camera_world[camera] @ [*target, 1.0])[:3] for camera in (left, left + 1)
        ]
        assert at_target[0][0] / at_target[0][2] == pytest.approx(at_target[1][0] / at_target[1][2])


def test_light_ends_where_a_plate_casts_its_shadow() -> None:
    wall, screen = plate(0.0, 0.6), plate(0.5, 0.1, x=0.05)
    lamp = np.array([0.0, 0.0, 1.0], np.float32)
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.5, 0.5, (400, 2)), np.zeros(400)]).astype(np.float32)
    cosine = SurfaceScene([wall, screen]).incidence(points, lamp)
    shaded = (np.abs(points[:, 0] - 0.1) < 0.2) & (np.abs(points[:, 1]) < 0.2)  # twice the plate's size
    np.testing.assert_array_equal(cosine == 0, shaded)
    expected = 1 / np.sqrt(1 + (points**2).sum(axis=1))
    np.testing.assert_allclose(cosine[~shaded], expected[~shaded], atol=1e-5)


@pytest.mark.parametrize("z", [-0.31, 0.0, 0.27])
def test_a_wall_is_found_where_it_stands(z: float) -> None:
    """To 0.4 pixels of disparity by the matcher, which prefers whole ones, and to 0.1 after refinement."""
    rig, wall = front_pod(1.4), plate(z, 0.45)
    pair = speckle_pair(SurfaceScene([wall]), rig, 0, config=POD, rng=np.random.default_rng(1))
    truth = true_depth(rig, [wall])
    for steps, pixels in ((0, 0.4), (4, 0.1)):
        depth = match_pair(pair, grey(pair), config=replace(POD, refinement_steps=steps))
        both = (depth > 0) & (truth > 0)
        assert both.sum() > 0.9 * (truth > 0).sum()
        one_pixel = truth[both][0] ** 2 / (pair.focal_px * pair.baseline_m)
        assert np.median(np.abs(depth[both] - truth[both])) < pixels * one_pixel


def test_silhouettes_grow_until_they_are_cleaned_and_shadows_are_holes() -> None:
    rig, surfaces = front_pod(1.4), [plate(-0.2, 0.45), plate(0.25, 0.12, x=0.03)]
    pair = speckle_pair(SurfaceScene(surfaces), rig, 0, config=POD, rng=np.random.default_rng(2))
    truth = true_depth(rig, surfaces)
    raw, cleaned = (match_pair(pair, grey(pair), config=replace(POD, step_m=step)) for step in (0.0, POD.step_m))
    wrong = [(depth > 0) & (np.abs(depth - truth) > 0.05) for depth in (raw, cleaned)]
    assert wrong[0].sum() > 100
    assert wrong[1].sum() < 0.5 * wrong[0].sum()
    assert ((cleaned == 0) & (truth > 0)).sum() > 300


def test_a_stereo_scan_has_the_shape_colours_and_labels_of_its_surfaces() -> None:
    config = ScannerConfig(
        sensor="stereo",
        stereo=StereoConfig(pods=8, image_size=256, supersampling=1, speckle_window_px=40),
        fusion=FusionConfig(min_component_faces=200),
    )
    surfaces = [sphere(0.3, (47, 98, 201), LABEL_GARMENT, band=0.03), sphere(0.27, (150, 152, 156), LABEL_BODY)]
    rig = pod_rig(centre=(0.0, 0.0, 0.0), radius=0.4, config=config.stereo)
    scans = [scan_surfaces(rig, surfaces, config=config, rng=np.random.default_rng(seed)) for seed in (5, 5, 6)]
    (scan, labels), (again, labels_again), (other, _) = scans
    np.testing.assert_array_equal(scan.mesh.vertices, again.mesh.vertices)
    np.testing.assert_array_equal(labels, labels_again)
    assert len(other.mesh.vertices) != len(scan.mesh.vertices)

    height = scan.mesh.vertices[:, 1]
    radius = np.linalg.norm(scan.mesh.vertices, axis=1)
    upper, lower = height > -0.14, height < -0.18
    assert upper.sum() > 5000
    assert np.median(np.abs(radius[upper] - 0.3)) < 0.0025
    assert np.median(np.abs(radius[lower] - 0.27)) < 0.0025
    assert (labels[upper & (height > -0.11)] == LABEL_GARMENT).mean() > 0.99
    assert (labels[lower] == LABEL_BODY).mean() > 0.99
    band = (height > -0.145) & (height < -0.125) & (radius > 0.295)
    assert (labels[band] == LABEL_BORDER).mean() > 0.95
    blue, red = scan.colours[:, 2].astype(int), scan.colours[:, 0].astype(int)
    assert (blue > red)[labels == LABEL_GARMENT].mean() > 0.98
    assert (red > blue)[band].mean() > 0.95
