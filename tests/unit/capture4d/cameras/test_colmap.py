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
from capture4d.cameras.colmap_files import MODELS
from capture4d.cameras.projection import Lens, project, project_world
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
    lens = lens_of(camera)
    matrix, bent = lens.intrinsics, lens.distortion
    assert (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]) == intrinsics
    assert tuple(bent) == distortion


def test_other_cameras_are_refused():
    pycolmap = import_pycolmap()
    prism = pycolmap.Camera(camera_id=3, model="THIN_PRISM_FISHEYE", width=9, height=9, params=[9.0] * 12)
    with pytest.raises(InputError, match=r"camera 3: expected one of SIMPLE_PINHOLE.* found THIN_PRISM_FISHEYE"):
        lens_of(prism)
    with pytest.raises(InputError, match="expected no skew"):
        colmap_camera(1, Lens(np.array([[9, 0.5, 4], [0, 9, 4], [0, 0, 1.0]]), np.zeros(5)), np.array([9, 9]))


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


POINTS = "300.5 200.25 7 10 20 -1"


def hand_written(folder: Path, images: str, cameras: str = "1 PINHOLE 640 480 900 910 320.5 240.5") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_bytes(f"{cameras}\n".encode())
    (folder / "images.txt").write_bytes(images.encode())
    return folder


def image_line(number: int, name: str, quaternion: str = "1 0 0 0", camera: int = 1) -> str:
    return f"{number} {quaternion} {number} 0.5 2 {camera} {name}"


@pytest.mark.parametrize(
    "text",
    [
        "{0}\n\n{1}\n\n{2}\n\n",
        "{0}\n{1}\n{2}\n",
        "{0}\n{1}\n{2}",
        "{0}\n" + POINTS + "\n{1}\n{2}\n" + POINTS + "\n",
        "{0}\n\n{1}\n" + POINTS + "\n{2}",
        "# by hand\n#\n{0}\n# not seen in any\n{1}\n   # third\n\n{2}\n",
        "\n\n{0}\n\n\n\n{1}\n{2}\n\n\n",
        "\ufeff{0}\r\n{1}\r\n\r\n{2}\r\n",
        "  {0}  \n\t{1}\n{2}\n",
        "{0}\n" + POINTS + " " + POINTS + " " + POINTS + "\n{1}\n" + POINTS + "\n{2}\n\n",
    ],
)
@pytest.mark.parametrize(
    "names", [("a.png", "b.png", "c.png"), ("my cam 1.png", "my cam 2.png", "x/3 4.JPG"), ("1", "2", "3")]
)
def test_images_may_be_written_by_hand(tmp_path: Path, text: str, names: tuple[str, ...]):
    lines = [image_line(number, name) for number, name in enumerate(names, start=1)]
    rig = read_model(hand_written(tmp_path, text.format(*lines)))
    assert rig.names == tuple(Path(name).stem for name in names)
    np.testing.assert_array_equal(rig.T_camera_world[:, :3, 3], [[1, 0.5, 2], [2, 0.5, 2], [3, 0.5, 2]])


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["a/0.png", "b/0.png"], "a_0 b_0"),
        (["a\\0.png", "b\\0.png"], "a_0 b_0"),
        (["a.png", "a.jpg"], "a.png a.jpg"),
        (["cam.01", "cam.02"], "cam.01 cam.02"),
        (["./x.tiff", "y.jp2"], "x y"),
        (["Kamera_ä.png", "カメラ.png"], "Kamera_ä カメラ"),
    ],
)
def test_cameras_are_called_after_their_images(tmp_path: Path, names: list[str], expected: str):
    text = "\n".join(image_line(number, name) for number, name in enumerate(names, start=1))
    assert " ".join(read_model(hand_written(tmp_path, text)).names) == expected


@pytest.mark.parametrize("scale", [1.0, 3.0, 1e-200, 1e200, -0.5])
def test_quaternions_are_made_unit(tmp_path: Path, scale: float):
    x, y, z, w = Rotation.from_rotvec([0.3, -0.5, 0.9]).as_quat() * scale
    rig = read_model(hand_written(tmp_path, image_line(1, "a.png", f"{w:.17g} {x:.17g} {y:.17g} {z:.17g}")))
    expected = Rotation.from_rotvec([0.3, -0.5, 0.9]).as_matrix()
    np.testing.assert_allclose(rig.T_camera_world[0, :3, :3], expected, atol=1e-12)


@pytest.mark.parametrize(
    ("images", "fault"),
    [
        (image_line(1, "a.png", "0 0 0 0"), r"images\.txt:1: expected a pose, found 0 0 0 0"),
        (image_line(1, "a.png", "nan 0 0 0"), r"images\.txt:1: expected a pose, found nan"),
        (image_line(1, "a.png", "1 0 inf 0"), r"images\.txt:1: expected a pose"),
        (f"{image_line(1, 'a.png')}\n\n{image_line(2, 'a.png')}", r"different names, found 'a\.png' twice"),
        (f"{image_line(1, 'a.png')}\n\n{image_line(1, 'b.png')}", r"images\.txt: .*found image 1 twice"),
        (image_line(1, "a.png", camera=4), r"image a\.png: expected camera 4, found none"),
        (image_line(1, ".."), r"camera '\.\.': expected a name without separators"),
        ("1 1 0 0 0 1 2", r"images\.txt:1: not a readable COLMAP model, expected ID QW"),
        (f"{image_line(1, 'a.png')}\n1 2 3 4", r"images\.txt:2: .*, or X Y POINT3D of every point"),
        (f"{image_line(1, 'a.png')}\n1 2 0.5", r"images\.txt:2: .*, or X Y POINT3D of every point"),
        ("# nothing\n", "expected a model with images that have poses, found none"),
    ],
)
def test_images_that_cannot_be_meant_are_one_line(tmp_path: Path, images: str, fault: str):
    with pytest.raises(InputError, match=fault) as caught:
        read_model(hand_written(tmp_path, images))
    assert "\n" not in str(caught.value)
    assert caught.value.where is not None


@pytest.mark.parametrize(
    ("cameras", "fault"),
    [
        ("1 PINHOLE 640 480 900 910 320.5", "expected 4 parameters of PINHOLE, found 3"),
        ("1 PINHOLE 640 0 900 910 320.5 240.5", "expected the size of an image, found 640 x 0"),
        ("1 PINHOLE 640 480 -900 910 320.5 240.5", "camera 'a': expected positive focal lengths"),
        ("1 PINHOLE 640 480 900 nan 320.5 240.5", "expected finite parameters"),
        ("1 THIN_PRISM_FISHEYE 640 480 900 910 320 240 0 0 0 0 0 0 0 0", "found THIN_PRISM_FISHEYE"),
        ("1 EUCM 640 480 900 910 320 240 0.5 1", "found EUCM"),
        ("1 FULL_OPENCV 640 480 900 910 320 240 0 0 0 0 0 0.1 0 0", "without k4 to k6, found FULL_OPENCV"),
        ("1 NEW_LENS 640 480 900", "found NEW_LENS"),
        ("1 PINHOLE 640 480 900 910 320 240\n1 PINHOLE 640 480 900 910 320 240", "found camera 1 twice"),
    ],
)
def test_cameras_that_cannot_be_meant_are_one_line(tmp_path: Path, cameras: str, fault: str):
    with pytest.raises(InputError, match=fault) as caught:
        read_model(hand_written(tmp_path, image_line(1, "a.png"), cameras))
    assert "\n" not in str(caught.value)


def test_order_and_cameras_that_no_image_uses_do_not_matter(tmp_path: Path):
    cameras = "9 EUCM 5 5 1 1 1 1 0 1\n2 PINHOLE 64 48 90 91 32 24\n1 PINHOLE 640 480 900 910 320.5 240.5"
    images = f"{image_line(7, 'late.png')}\n\n{image_line(3, 'early.png', camera=2)}\n"
    rig = read_model(hand_written(tmp_path, images, cameras))
    assert rig.names == ("early", "late")
    assert rig.image_sizes.tolist() == [[64, 48], [640, 480]]


def test_a_model_may_lie_below_the_folder(tmp_path: Path):
    hand_written(tmp_path / "work" / "sparse" / "0", image_line(1, "a.png"))
    (tmp_path / "work" / "images").mkdir()
    for place in ("work", "work/sparse", "work/sparse/0"):
        assert read_model(tmp_path / place).names == ("a",)
    hand_written(tmp_path / "work" / "sparse" / "1", image_line(1, "b.png"))
    with pytest.raises(InputError, match=r"found 2 \(sparse/0, sparse/1\); give one of them"):
        read_model(tmp_path / "work")
    assert read_model(tmp_path / "work" / "sparse" / "1").names == ("b",)


def test_where_a_model_lies_twice_the_binary_one_counts(rig: Rig, tmp_path: Path):
    hand_written(tmp_path, image_line(1, "a.png"))
    write_model(tmp_path, rig)
    theirs = {image.name for image in import_pycolmap().Reconstruction(tmp_path).images.values()}
    assert {f"{name}.png" for name in read_model(tmp_path).names} == theirs


def test_pycolmaps_reader_is_never_asked(rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """It spins, or ends the process, on files that lie."""
    write_model(tmp_path, rig)

    def never() -> None:
        raise AssertionError("read by pycolmap")

    monkeypatch.setattr("capture4d.cameras.colmap.import_pycolmap", never)
    assert read_model(tmp_path).names == rig.names


def fault_of(folder: Path) -> str:
    """What is said of a model; nothing if it is read."""
    try:
        read_model(folder)
    except InputError as error:
        return f"{error.where}: {error.reason}"
    return ""


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("cut", [0.0, 0.1, 0.4, 0.7, 0.95])
def test_files_that_are_cut_off_are_read_or_named(rig: Rig, tmp_path: Path, text: bool, cut: float):
    write_model(tmp_path, rig, text=text)
    for path in sorted(tmp_path.iterdir()):
        whole = path.read_bytes()
        path.write_bytes(whole[: int(cut * len(whole))])
        assert "\n" not in fault_of(tmp_path)
        path.write_bytes(whole)


def fisheye_rig() -> Rig:
    rig = calibration_rig(3, rng=np.random.default_rng(7), focal_px=700.0)
    bent = np.array([[0.02, -0.01, 4e-3, -1e-3, 0], [-0.11, 0.09, 1e-3, -2e-3, 0], [0.05, 0.01, 0, 0, 0]])
    return replace(rig, distortion=bent, lenses=("fisheye", "brown", "fisheye"))


@pytest.mark.parametrize("text", [False, True])
def test_fisheyes_come_and_go(tmp_path: Path, text: bool):
    rig = fisheye_rig()
    write_model(tmp_path, rig, text=text)
    again = read_model(tmp_path)
    assert again.lenses == rig.lenses
    np.testing.assert_allclose(again.distortion, rig.distortion, atol=1e-15)
    model = import_pycolmap().Reconstruction(tmp_path)
    points = np.random.default_rng(8).uniform(-0.9, 0.9, (40, 3)) + np.array([0.0, 1.1, 0.0])
    for index, name in enumerate(rig.names):
        image = model.find_image_with_name(f"{name}.png")
        theirs = np.array([image.project_point(point) for point in points])
        np.testing.assert_allclose(theirs, project_world(rig, index, points)[0] + 0.5, atol=1e-8)


@pytest.mark.parametrize(
    ("model", "parameters"),
    [
        ("SIMPLE_FISHEYE", [400, 320.5, 240.5]),
        ("FISHEYE", [400, 410, 320.5, 240.5]),
        ("SIMPLE_RADIAL_FISHEYE", [400, 320.5, 240.5, -0.05]),
        ("RADIAL_FISHEYE", [400, 320.5, 240.5, 0.03, -0.02]),
        ("OPENCV_FISHEYE", [400, 410, 320.5, 240.5, 0.03, -0.02, 0.01, -0.003]),
        ("SIMPLE_RADIAL", [400, 320.5, 240.5, -0.05]),
        ("RADIAL", [400, 320.5, 240.5, -0.05, 0.01]),
        ("OPENCV", [400, 410, 320.5, 240.5, -0.05, 0.01, 1e-3, -2e-3]),
        ("FULL_OPENCV", [400, 410, 320.5, 240.5, -0.05, 0.01, 1e-3, -2e-3, 0.003, 0, 0, 0]),
    ],
)
def test_lenses_are_pycolmaps(model: str, parameters: list[float]):
    camera = import_pycolmap().Camera(camera_id=1, model=model, width=640, height=480, params=parameters)
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3)) + np.array([0, 0, 1.5])
    theirs = np.array([camera.img_from_cam(point) for point in points])
    np.testing.assert_allclose(project(points, lens_of(camera)), theirs - 0.5, atol=1e-9)


def test_the_table_of_models_is_pycolmaps():
    pycolmap = import_pycolmap()
    known = {name: int(number) for name, number in pycolmap.CameraModelId.__members__.items() if int(number) >= 0}
    assert {name: number for number, (name, _) in enumerate(MODELS)} == known
    for name, count in MODELS:
        camera = pycolmap.Camera.create_from_model_name(1, name, 10.0, 8, 6)
        assert len(camera.params) == count


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "frames.bin"])
def test_counts_that_lie_are_one_line(name: str, rig: Rig, tmp_path: Path):
    write_model(tmp_path, rig)
    path = tmp_path / name
    path.write_bytes(struct.pack("<Q", 2**62) + path.read_bytes()[8:])
    with pytest.raises(InputError, match="not a readable COLMAP model") as caught:
        read_model(tmp_path)
    assert caught.value.where == str(path)
