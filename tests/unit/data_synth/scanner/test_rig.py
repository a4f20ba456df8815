import numpy as np
import pytest

from capture4d.errors import InputError
from data_synth.scanner.rig import bounding_sphere, capture_rig, look_at


def project(rig, camera, points):
    local = points @ rig.T_camera_world[camera, :3, :3].T + rig.T_camera_world[camera, :3, 3]
    pixels = local @ rig.intrinsics[camera].T
    return pixels[:, :2] / pixels[:, 2:], local[:, 2]


@pytest.mark.parametrize("cameras", [20, 30, 48])
def test_every_camera_looks_at_the_subject_the_right_way_up(cameras):
    centre, radius = np.array([0.3, 1.1, -0.2]), 0.5
    rig = capture_rig(centre=centre, radius=radius, cameras=cameras, image_size=256)
    assert len(set(rig.names)) == cameras
    for camera in range(cameras):
        rotation = rig.T_camera_world[camera, :3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1)
        (middle, above, beside), depth = project(
            rig, camera, centre + np.stack([np.zeros(3), [0, 0.1, 0], -0.1 * rotation[0]])
        )
        assert (depth > 0).all()
        assert (np.abs(middle - 127.5) < 128).all()
        assert above[1] < middle[1]  # up in the world is up in the image
        assert beside[0] < middle[0]


def test_the_middle_ring_sees_the_whole_sphere():
    rig = capture_rig(centre=(0.0, 1.0, 0.0), radius=0.5)
    directions = np.random.default_rng(0).standard_normal((200, 3))
    points = [0, 1, 0] + 0.5 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    for camera, name in enumerate(rig.names):
        if name.startswith("middle"):
            pixels, _ = project(rig, camera, points)
            assert pixels.min() > 0
            assert pixels.max() < 511


def test_the_rig_scales_with_the_subject():
    small, large = capture_rig(radius=0.5, centre=(0.0, 0.0, 0.0)), capture_rig(radius=5.0, centre=(0.0, 0.0, 0.0))
    np.testing.assert_allclose(10 * small.T_camera_world[:, :3, 3], large.T_camera_world[:, :3, 3], atol=1e-9)
    np.testing.assert_array_equal(small.intrinsics, large.intrinsics)


def test_looking_along_minus_z_keeps_x_to_the_right():
    transform = look_at((0.0, 0.0, 2.0), (0.0, 0.0, 0.0))
    np.testing.assert_allclose(transform @ [1, 2, 0, 1], [1, -2, 2, 1], atol=1e-12)


def test_bounding_sphere_holds_every_point():
    points = np.random.default_rng(1).standard_normal((4, 50, 3))
    centre, radius = bounding_sphere(points)
    assert np.linalg.norm(points - centre, axis=-1).max() == pytest.approx(radius)


def test_bad_arguments_are_named():
    with pytest.raises(InputError, match="cameras"):
        capture_rig(cameras=2)
    with pytest.raises(InputError, match="radius"):
        capture_rig(radius=0.0)
    with pytest.raises(InputError, match="vertical"):
        look_at((0.0, 1.0, 0.0), (0.0, 0.0, 0.0))
