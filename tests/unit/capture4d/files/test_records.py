"""rig.json: what is read, and what cannot be a camera."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.errors import InputError
from capture4d.files.records import load_rig, save_rig

CAMERA = {
    "name": "front",
    "width": 640,
    "height": 480,
    "intrinsics": [[500, 0, 320], [0, 510, 240], [0, 0, 1]],
    "distortion": [0.1, 0, 0, 0, 0],
    "T_camera_world": np.eye(4).tolist(),
}


def rig_file(path: Path, **change: Any) -> Path:
    camera = {name: value for name, value in {**CAMERA, **change}.items() if value is not ...}
    path.write_text(json.dumps({"format": 1, "cameras": [{**CAMERA, "name": "back"}, camera]}))
    return path


def turned(change: Any) -> list[list[float]]:
    matrix = np.eye(4)
    matrix[:3, :3] = change
    return matrix.tolist()


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"name": "back"}, "camera 'back': expected a name of its own"),
        ({"name": ""}, "camera '': expected a name without separators"),
        ({"name": ".."}, "camera '..': expected a name without separators"),
        ({"name": "../x"}, "camera '../x': expected a name without separators"),
        ({"name": "a/b"}, "expected a name without separators"),
        ({"name": "a\\b"}, "expected a name without separators"),
        ({"name": "a\0"}, r"camera 'a\\x00': expected a name without separators"),
        ({"name": "a\n"}, "expected a name without separators"),
        ({"name": "\ud800"}, "expected a name without separators"),
        ({"name": ["a"]}, "expected a text as the name"),
        ({"name": ...}, "expected the entry 'name' for every camera"),
        ({"width": 0}, "camera 'front': expected the size of an image, found 0 x 480"),
        ({"height": -480}, "camera 'front': expected the size of an image, found 640 x -480"),
        ({"width": 640.5}, "camera 'front': expected whole pixels"),
        ({"width": "640"}, "camera 'front': expected whole pixels"),
        ({"width": 2**40}, "camera 'front': expected the size of an image"),
        ({"intrinsics": [[0, 0, 320], [0, 510, 240], [0, 0, 1]]}, "camera 'front': expected positive focal lengths"),
        ({"intrinsics": [[500, 0, 320], [0, -5, 240], [0, 0, 1]]}, "expected positive focal lengths.*found 500 and -5"),
        ({"intrinsics": [[500, 0, 320], [0, 510, 240], [0, 0, 2]]}, "last row of 0 0 1, found 0 0 2"),
        ({"intrinsics": [500, 510, 320, 240]}, "camera 'front': expected 3 x 3 numbers as intrinsics, found 4"),
        ({"intrinsics": "none"}, "camera 'front': expected numbers as intrinsics"),
        ({"distortion": [0, 0, 0, 0]}, "camera 'front': expected 5 numbers as distortion, found 4"),
        ({"lens": "fisheye"}, "camera 'front': expected 4 numbers as distortion, found 5"),
        ({"lens": "fov"}, "camera 'front': expected a lens of brown, fisheye, found 'fov'"),
        ({"lens": None}, "camera 'front': expected a lens of brown, fisheye, found None"),
        ({"distortion": [0, 0, 0, 0, float("nan")]}, "expected finite numbers, found NaN"),
        ({"T_camera_world": turned(np.diag([1, 1, 1.1]))}, "camera 'front': expected a rotation.* lengths 1, 1, 1.1"),
        ({"T_camera_world": turned(1e-3 * np.eye(3))}, "camera 'front': expected a rotation"),
        ({"T_camera_world": turned(np.diag([1, 1, -1]))}, "camera 'front': expected a rotation.* a mirror image"),
        ({"T_camera_world": turned(np.zeros((3, 3)))}, "camera 'front': expected a rotation"),
        ({"T_camera_world": turned(np.eye(3) + 0.01)}, "camera 'front': expected a rotation"),
        (
            {"T_camera_world": np.eye(3).tolist()},
            "camera 'front': expected 4 x 4 numbers as T_camera_world, found 3 x 3",
        ),
        ({"T_camera_world": np.diag([1, 1, 1, 2]).tolist()}, "last row of 0 0 0 1, found 0 0 0 2"),
    ],
)
def test_cameras_that_cannot_be_are_refused_by_name(tmp_path: Path, change: dict[str, Any], fault: str):
    path = rig_file(tmp_path / "rig.json", **change)
    with pytest.raises(InputError, match=fault) as caught:
        load_rig(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_rounding_in_a_file_is_no_fault(tmp_path: Path):
    turn = np.round(Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix(), 5)
    load_rig(rig_file(tmp_path / "rig.json", T_camera_world=turned(turn)))
    with pytest.raises(InputError, match="expected a rotation"):
        load_rig(rig_file(tmp_path / "rig.json", T_camera_world=turned(np.round(turn, 2))))


def test_a_fisheye_stands_in_the_file_and_others_do_not(tmp_path: Path):
    path = rig_file(tmp_path / "rig.json", lens="fisheye", distortion=[0.1, 0.2, 0.3, 0.4])
    rig = load_rig(path)
    assert rig.lenses == ("brown", "fisheye")
    assert rig.distortion.tolist() == [[0.1, 0, 0, 0, 0], [0.1, 0.2, 0.3, 0.4, 0]]
    save_rig(path, rig)
    first, second = json.loads(path.read_text())["cameras"]
    assert "lens" not in first
    assert (second["lens"], second["distortion"]) == ("fisheye", [0.1, 0.2, 0.3, 0.4])
