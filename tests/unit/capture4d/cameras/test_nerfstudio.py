"""transforms.json, against COLMAP's model of the same cameras and OpenCV's projection."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from benchmarks.simulated_views import calibration_rig
from capture4d.cameras.exchange import convert_rig
from capture4d.cameras.nerfstudio import read_transforms
from capture4d.cameras.projection import project_world
from capture4d.errors import InputError
from capture4d.files.records import load_rig, save_rig
from capture4d.types import Rig
from tests.command_line import fails

TURNED = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])
"""What nerfstudio does to COLMAP's world."""


def transforms(rig: Rig, *, per_frame: bool = True, applied: np.ndarray | None = None, scale: float = 1.0) -> dict:
    """As nerfstudio writes it: OpenGL's axes, COLMAP's pixels."""
    frames: list[dict[str, Any]] = []
    for index, name in enumerate(rig.names):
        pose = np.linalg.inv(rig.T_camera_world[index])
        pose[:, 1:3] *= -1
        if applied is not None:
            pose = np.concatenate([applied, [[0, 0, 0, 1]]]) @ pose
        pose[:3, 3] *= scale
        frames.append({"file_path": f"images/{name}.png", "transform_matrix": pose.tolist(), **lens(rig, index)})
    top: dict[str, Any] = {}
    if not per_frame:
        top = {key: frames[0][key] for key in lens(rig, 0)}
        frames = [{key: frame[key] for key in ("file_path", "transform_matrix")} for frame in frames]
    if applied is not None:
        top |= {"applied_transform": applied.tolist(), "applied_scale": scale}
    return {**top, "frames": frames}


def lens(rig: Rig, index: int) -> dict[str, Any]:
    K, D, (width, height) = rig.intrinsics[index], rig.distortion[index], rig.image_sizes[index].tolist()
    fisheye = rig.lenses[index] == "fisheye"
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    return {
        "camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV",
        "fl_x": K[0, 0],
        "fl_y": K[1, 1],
        "cx": K[0, 2] + 0.5,
        "cy": K[1, 2] + 0.5,
        "w": width,
        "h": height,
        **dict(zip(names, D.tolist(), strict=False)),
    }


def written(path: Path, content: Any) -> Path:
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize("fisheye", [False, True])
@pytest.mark.parametrize("per_frame", [False, True])
@pytest.mark.parametrize(("applied", "scale"), [(None, 1.0), (TURNED, 1.0), (TURNED, 0.37)])
def test_a_rig_comes_back(tmp_path: Path, fisheye: bool, per_frame: bool, applied: np.ndarray | None, scale: float):
    rig = calibration_rig(4, rng=np.random.default_rng(3))
    if fisheye:
        bent = rig.distortion * (0.3, 0.1, 1, 1, 0)
        rig = replace(rig, distortion=bent, lenses=("fisheye",) * 4)
    if not per_frame:
        rig = replace(rig, intrinsics=rig.intrinsics[[0] * 4], distortion=rig.distortion[[0] * 4])
    found = read_transforms(
        written(tmp_path / "t.json", transforms(rig, per_frame=per_frame, applied=applied, scale=scale))
    )
    assert (found.names, found.lenses) == (rig.names, rig.lenses)
    for name in ("intrinsics", "distortion", "T_camera_world", "image_sizes"):
        np.testing.assert_allclose(getattr(found, name), getattr(rig, name), atol=1e-9)


def test_a_last_row_that_was_inverted_is_taken(tmp_path: Path):
    content = transforms(calibration_rig(2, rng=np.random.default_rng(3)))
    plain = read_transforms(written(tmp_path / "plain.json", content))
    content["frames"][0]["transform_matrix"][3] = [1e-9, 0, -1e-8, 1.0000001]
    found = read_transforms(written(tmp_path / "off.json", content))
    np.testing.assert_array_equal(found.T_camera_world, plain.T_camera_world)


def test_what_is_up_in_opengl_is_up_in_the_image(tmp_path: Path):
    """A camera at the origin that looks down -z, as OpenGL's do, and OpenCV's projection of what it sees."""
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
    rig = read_transforms(written(tmp_path / "t.json", {"w": 640, "h": 480, "fl_x": 500, "frames": [frame]}))
    points = np.array([[0.0, 0, -2], [0.2, 0, -2], [0, 0.1, -2]])
    pixels, seen = project_world(rig, 0, points)
    assert seen.all()
    K = np.array([[500, 0, 319.5], [0, 500, 239.5], [0, 0, 1]])
    expected = cv2.projectPoints(points * (1, -1, -1), np.zeros(3), np.zeros(3), K, np.zeros(5))[0].reshape(-1, 2)
    np.testing.assert_allclose(pixels, expected, atol=1e-9)
    assert pixels[2, 1] < pixels[0, 1]


@pytest.mark.parametrize(
    ("entries", "focal"),
    [
        ({"camera_angle_x": 1.0}, (320 / np.tan(0.5),) * 2),
        ({"camera_angle_x": 1.0, "camera_angle_y": 0.8}, (320 / np.tan(0.5), 240 / np.tan(0.4))),
        ({"x_fov": 60.0}, (320 / np.tan(np.radians(30)),) * 2),
        ({"fl_x": 500.0}, (500, 500)),
        ({"fl_x": 500.0, "fl_y": 510.0, "camera_angle_x": 1.0}, (500, 510)),
    ],
)
@pytest.mark.parametrize("model", [{}, {"camera_model": "PINHOLE"}, {"camera_model": "SIMPLE_PINHOLE"}])
def test_focal_lengths_may_be_angles(
    tmp_path: Path, entries: dict[str, float], focal: tuple[float, float], model: dict
):
    frames = [{"file_path": f"./train/r_{index}", "transform_matrix": np.eye(4).tolist()} for index in range(2)]
    rig = read_transforms(written(tmp_path / "t.json", {"w": 640, "h": 480, **entries, **model, "frames": frames}))
    np.testing.assert_allclose(rig.intrinsics[0, [0, 1], [0, 1]], focal)
    np.testing.assert_allclose(rig.intrinsics[0, :2, 2], (319.5, 239.5))
    assert rig.names == ("r_0", "r_1")


@pytest.mark.parametrize(
    ("entries", "expected"),
    [
        ({"k1": 0.1, "k2": 0.2, "p1": 0.01, "p2": 0.02, "k3": 0.3}, [0.1, 0.2, 0.01, 0.02, 0.3]),
        ({"distortion_params": [0.1, 0.2, 0.3, 0.0, 0.01, 0.02]}, [0.1, 0.2, 0.01, 0.02, 0.3]),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k4": 0.4}, [0.1, 0, 0, 0.4, 0]),
        ({"is_fisheye": True, "k1": 0.1}, [0.1, 0, 0, 0, 0]),
    ],
)
def test_distortion_is_put_in_opencvs_order(tmp_path: Path, entries: dict[str, Any], expected: list[float]):
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
    rig = read_transforms(written(tmp_path / "t.json", {"w": 640, "h": 480, "fl_x": 500, **entries, "frames": [frame]}))
    np.testing.assert_array_equal(rig.distortion[0], expected)


GOOD = {"w": 640, "h": 480, "fl_x": 500.0, "file_path": "a.png", "transform_matrix": np.eye(4).tolist()}


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"w": None}, "frame 'a.png': expected a finite number as w, found None"),
        ({"w": 640.5}, "expected whole pixels as w"),
        ({"h": 0}, "expected whole pixels as h"),
        ({"fl_x": "500"}, "expected a finite number as fl_x, found '500'"),
        ({"fl_x": -1.0}, "camera 'a': expected positive focal lengths"),
        ({"fl_x": float("nan")}, "expected finite numbers, found NaN"),
        ({"k4": 0.1}, "expected no k4 of a lens of OPENCV"),
        ({"camera_model": "OPENCV_FISHEYE", "p1": 0.1}, "expected no p1 of a lens of OPENCV_FISHEYE"),
        ({"camera_model": "EQUIRECTANGULAR"}, "expected a camera_model of OPENCV.*found 'EQUIRECTANGULAR'"),
        ({"camera_angle_x": 4.0, "fl_x": ...}, "expected an angle of view between 0 and 180"),
        ({"fl_x": ...}, "expected fl_x or camera_angle_x, found neither"),
        ({"h": ...}, "expected the size of the images as w and h, found no h"),
        ({"transform_matrix": ...}, "frame 'a.png': expected the entry 'transform_matrix'"),
        ({"transform_matrix": [[1, 2], [3]]}, "expected 3 x 4 or 4 x 4 finite numbers"),
        ({"transform_matrix": np.zeros((4, 4)).tolist()}, "expected a last row of 0 0 0 1"),
        ({"transform_matrix": np.diag([0.0, 0, 0, 1]).tolist()}, "expected a rotation in its transform_matrix"),
        ({"transform_matrix": np.diag([2.0, 2, 2, 1]).tolist()}, "camera 'a': expected a rotation"),
        ({"transform_matrix": np.diag([-1.0, 1, 1, 1]).tolist()}, "found a mirror image"),
        ({"file_path": 3}, "expected a text as the file_path"),
        ({"file_path": ".."}, "camera '..': expected a name"),
    ],
)
def test_frames_that_cannot_be_meant_are_one_line(tmp_path: Path, change: dict[str, Any], fault: str):
    frame = {name: value for name, value in {**GOOD, **change}.items() if value is not ...}
    path = written(tmp_path / "t.json", {"frames": [frame]})
    with pytest.raises(InputError, match=fault) as caught:
        read_transforms(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        ({"frames": []}, "expected a list of frames, found none"),
        ({"frames": {"a": 1}}, "expected a list of frames"),
        ({"frames": [1]}, "expected a list of frames"),
        ({"frames": [GOOD, GOOD]}, "images with different names, found 'a.png' twice"),
        ({"frames": [GOOD], "applied_transform": [[1]]}, "3 x 4 or 4 x 4 finite numbers as applied_transform"),
        ({"frames": [GOOD], "applied_transform": np.diag([1.0, 1, -1, 1]).tolist()}, "that mirror nothing"),
        ({"frames": [GOOD], "applied_scale": 0}, "that mirror nothing"),
    ],
)
def test_files_that_cannot_be_meant_are_one_line(tmp_path: Path, content: dict[str, Any], fault: str):
    with pytest.raises(InputError, match=fault):
        read_transforms(written(tmp_path / "t.json", content))


def test_kinds_are_told_by_content_and_not_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    rig = calibration_rig(3, rng=np.random.default_rng(1))
    save_rig(tmp_path / "transforms.json", rig)
    convert_rig(tmp_path / "transforms.json", tmp_path / "model")
    written(tmp_path / "rig.json", transforms(rig))
    convert_rig(tmp_path / "rig.json", tmp_path / "again.json")
    (tmp_path / "work").mkdir()
    written(tmp_path / "work" / "transforms.json", transforms(rig))
    convert_rig(tmp_path / "work", tmp_path / "third.json", scale=2.0)
    convert_rig(tmp_path / "model" / "cameras.bin", tmp_path / "fourth.json")
    for name, scale in (("again", 1), ("third", 2), ("fourth", 1)):
        np.testing.assert_allclose(load_rig(tmp_path / f"{name}.json").centres, scale * rig.centres, atol=1e-9)
    (tmp_path / "x.json").write_text("{}")
    assert "expected the entry 'cameras', found none" in fails(
        capsys, "convert-rig", tmp_path / "x.json", "--output", tmp_path / "y"
    )
    assert "no such file" in fails(capsys, "convert-rig", tmp_path / "none", "--output", tmp_path / "y")
    (tmp_path / "empty").write_bytes(b"")
    assert "not valid JSON" in fails(capsys, "convert-rig", tmp_path / "empty", "--output", tmp_path / "y")
