"""COLMAP models: the same point through both, and there and back without a loss."""

import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.simulated_views import calibration_rig
from capture4d.cameras.colmap import colmap_camera, lens_of, read_model, sensor, to_colmap_pixels, write_model
from capture4d.cameras.projection import project_world
from capture4d.errors import InputError
from capture4d.heavy_imports import import_pycolmap
from capture4d.types import Rig

ROOT = Path(__file__).parents[4]


@pytest.fixture(params=[0, 1])
def rig(request: pytest.FixtureRequest) -> Rig:
    return calibration_rig(5, rng=np.random.default_rng(request.param))


@pytest.mark.parametrize("k3", [0.0, 0.02])
def test_a_point_falls_on_the_same_pixel_in_colmap(rig: Rig, tmp_path: Path, k3: float):
    """Axes, units, the order of the distortion and the half pixel, all at once."""
    rig = replace(rig, distortion=rig.distortion + np.array([0, 0, 0, 0, k3]))
    write_model(tmp_path, rig)
    model = import_pycolmap().Reconstruction(tmp_path)
    points = np.random.default_rng(8).uniform(-0.4, 0.4, (20, 3)) + np.array([0.0, 1.1, 0.0])
    for index, name in enumerate(rig.names):
        image = model.find_image_with_name(f"{name}.png")
        theirs = np.array([image.project_point(point) for point in points])
        ours, _ = project_world(rig, index, points)
        np.testing.assert_allclose(theirs, ours + 0.5, atol=1e-8)
        np.testing.assert_allclose(image.projection_center(), rig.centres[index], atol=1e-12)
    np.testing.assert_array_equal(to_colmap_pixels(np.zeros((1, 2))), [[0.5, 0.5]])


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("k3", [0.0, 0.02])
def test_a_rig_survives_the_round_trip(rig: Rig, tmp_path: Path, text: bool, k3: float):
    rig = replace(rig, distortion=rig.distortion + np.array([0, 0, 0, 0, k3]))
    write_model(tmp_path, rig, text=text)
    again = read_model(tmp_path)
    assert again.names == rig.names
    np.testing.assert_allclose(again.intrinsics, rig.intrinsics, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(again.distortion, rig.distortion)
    np.testing.assert_array_equal(again.image_sizes, rig.image_sizes)
    np.testing.assert_allclose(again.T_camera_world, rig.T_camera_world, atol=1e-13)
    assert (tmp_path / ("rigs.txt" if text else "rigs.bin")).is_file()


@pytest.mark.parametrize(
    ("model", "parameters", "intrinsics", "distortion"),
    [
        ("SIMPLE_PINHOLE", [900, 320.5, 240.5], (900, 900, 320, 240), (0, 0, 0, 0, 0)),
        ("PINHOLE", [900, 910, 320.5, 240.5], (900, 910, 320, 240), (0, 0, 0, 0, 0)),
        ("SIMPLE_RADIAL", [900, 320.5, 240.5, -0.1], (900, 900, 320, 240), (-0.1, 0, 0, 0, 0)),
        ("RADIAL", [900, 320.5, 240.5, -0.1, 0.02], (900, 900, 320, 240), (-0.1, 0.02, 0, 0, 0)),
    ],
)
def test_simpler_cameras_are_special_cases(model: str, parameters: list, intrinsics: tuple, distortion: tuple):
    pycolmap = import_pycolmap()
    camera = pycolmap.Camera(camera_id=1, model=model, width=640, height=480, params=parameters)
    matrix, bent = lens_of(camera)
    assert (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]) == intrinsics
    assert tuple(bent) == distortion


def test_other_cameras_are_refused():
    pycolmap = import_pycolmap()
    fisheye = pycolmap.Camera(camera_id=3, model="OPENCV_FISHEYE", width=9, height=9, params=[9, 9, 4, 4, 0, 0, 0, 0])
    with pytest.raises(InputError, match=r"camera 3: expected one of SIMPLE_PINHOLE.* found OPENCV_FISHEYE"):
        lens_of(fisheye)
    with pytest.raises(InputError, match="expected no skew"):
        colmap_camera(1, np.array([[9, 0.5, 4], [0, 9, 4], [0, 0, 1.0]]), np.zeros(5), np.array([9, 9]))


def test_a_model_without_a_rig_gives_one_camera_an_image(tmp_path: Path):
    pycolmap = import_pycolmap()
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=640, height=480, params=[900, 900, 320.5, 240.5])
    model.add_camera_with_trivial_rig(camera)
    for index in (1, 2):
        image = pycolmap.Image(name=f"shots/view{index}.jpg", camera_id=1, image_id=index)
        pose = np.eye(4)[:3]
        pose[0, 3] = index
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    model.write(tmp_path)
    rig = read_model(tmp_path)
    assert rig.names == ("view1", "view2")
    np.testing.assert_allclose(rig.T_camera_world[:, 0, 3], [1, 2])


def test_what_is_no_model_is_one_line(rig: Rig, tmp_path: Path):
    with pytest.raises(InputError, match="expected a COLMAP model"):
        read_model(tmp_path)
    write_model(tmp_path, rig)
    (tmp_path / "images.bin").write_bytes((tmp_path / "images.bin").read_bytes()[:60])
    with pytest.raises(InputError, match="not a readable COLMAP model") as caught:
        read_model(tmp_path)
    assert "\n" not in str(caught.value)


def test_opencv_writes_png_after_pycolmap_has_been_imported(tmp_path: Path):
    """With the imports in the other order the process aborts."""
    script = (
        "import sys, numpy as np\n"
        "from capture4d.heavy_imports import import_pycolmap\n"
        "import_pycolmap()\n"
        "import cv2\n"
        "assert cv2.imwrite(sys.argv[1], np.zeros((64, 64, 3), np.uint8))"
    )
    subprocess.run([sys.executable, "-c", script, str(tmp_path / "x.png")], check=True, cwd=ROOT, capture_output=True)


def test_a_model_is_read_as_pycolmap_reads_it(tmp_path: Path):
    """A rig of two cameras that moves through three frames, and an image alone."""
    pycolmap = import_pycolmap()
    model = pycolmap.Reconstruction()
    rng = np.random.default_rng(0)

    def pose() -> Any:
        turn = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
        return pycolmap.Rigid3d(np.column_stack([turn, rng.normal(size=3)]))

    rig = pycolmap.Rig(rig_id=1)
    for camera_id in (1, 2):
        parameters = [900.0 + camera_id, 901, 320.5, 240.5]
        model.add_camera(
            pycolmap.Camera(camera_id=camera_id, model="PINHOLE", width=640, height=480, params=parameters)
        )
        rig.add_ref_sensor(sensor(1)) if camera_id == 1 else rig.add_sensor(sensor(2), pose())
    model.add_rig(rig)
    for frame_id in (1, 2, 3):
        frame = pycolmap.Frame(frame_id=frame_id, rig_id=1)
        frame.rig_from_world = pose()
        for camera_id in (1, 2):
            frame.add_data_id(pycolmap.data_t(sensor(camera_id), 10 * frame_id + camera_id))
        model.add_frame(frame)
        for camera_id in (1, 2):
            name = f"cam {camera_id}/{frame_id:03d}.png"
            image = pycolmap.Image(name=name, camera_id=camera_id, image_id=10 * frame_id + camera_id)
            image.frame_id = frame_id
            model.add_image(image)
        model.register_frame(frame_id)
    for text in (False, True):
        folder = tmp_path / str(text)
        folder.mkdir()
        (model.write_text if text else model.write)(folder)
        found = read_model(folder)
        assert found.names == ("cam 1", "cam 2")
        expected = np.stack([model.images[number].cam_from_world().matrix() for number in (11, 12)])
        np.testing.assert_allclose(found.T_camera_world[:, :3], expected, atol=1e-9)
        for name in ("points3D", "rigs", "frames"):  # without frames, every image is a camera
            (folder / name).with_suffix(".txt" if text else ".bin").unlink()
        assert len(read_model(folder).names) == 6


def test_images_without_their_lines_of_points_are_named(rig: Rig, tmp_path: Path):
    write_model(tmp_path, rig, text=True)
    path = tmp_path / "images.txt"
    path.write_text("\n".join(line for line in path.read_text().splitlines() if line) + "\n")
    with pytest.raises(InputError, match=r"images\.txt:\d+: not a readable COLMAP model, expected X Y POINT3D"):
        read_model(tmp_path)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "frames.bin"])
def test_counts_that_lie_are_one_line(name: str, rig: Rig, tmp_path: Path):
    write_model(tmp_path, rig)
    path = tmp_path / name
    path.write_bytes(struct.pack("<Q", 2**62) + path.read_bytes()[8:])
    with pytest.raises(InputError, match="not a readable COLMAP model") as caught:
        read_model(tmp_path)
    assert caught.value.where == str(path)
