"""Which file is which frame, told by its name; one list for the check and for the stages."""

import os
from pathlib import Path

import numpy as np
import pytest

from capture4d.captures.capture import Capture, read_capture, read_frame, scan_path
from capture4d.captures.scan_files import KINDS, frame_numbers, list_scans, read_surface
from capture4d.errors import InputError
from capture4d.files.atomic import write_json
from capture4d.mesh_files.meshes import READABLE, write_mesh
from capture4d.preflight.take_folder import Claims, open_take
from capture4d.types import Mesh
from tests.shapes import tube

SQUARE = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32))
COLOURS = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255]], np.uint8)


@pytest.mark.parametrize(
    ("stems", "numbers"),
    [
        (["000001", "000002"], [1, 2]),
        (["1", "2", "10"], [1, 2, 10]),
        (["frame_0001", "frame_0002"], [1, 2]),
        (["scan.0001", "scan.0002"], [1, 2]),
        (["take3_000012", "take3_000013"], [12, 13]),
        (["frame_0012_v2", "frame_0013_v2"], [12, 13]),
        (["2024-05-01_take2_f001_lod0", "2024-05-01_take2_f002_lod0"], [1, 2]),
        (["Frame 1", "Frame 2 "], [1, 2]),
        (["MeshFrame-00001-cleaned", "MeshFrame-00002-cleaned"], [1, 2]),
        (["f1", "f01"], [1, 1]),
        (["take3_000012"], [12]),
        (["a_1", "b_1"], [1, 1]),
        (["0001", "extra"], [1, None]),
        (["9_5", "9_6", "lonely7"], [5, 6, 7]),
        (["٣", "frame"], [None, None]),
    ],
)
def test_the_number_of_a_frame_is_the_last_that_differs(stems: list[str], numbers: list[int | None]):
    assert frame_numbers(stems) == numbers


def capture_with(folder: Path, *names: str, frames: list[int] | None = None) -> Path:
    (folder / "scans").mkdir(parents=True, exist_ok=True)
    for name in names:
        path = folder / "scans" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x")
    write_json(folder / "capture.json", {"format": 1, "fps": 60, **({"frames": frames} if frames else {})})
    return folder


@pytest.mark.parametrize(
    "names",
    [
        ("000001.ply", "000002.PLY", "000003.Ply"),
        ("frame_0001.obj", "frame_0002.OBJ", "frame_0003.obj", "frame_0001.mtl", "frame_0001.png"),
        ("take2_01.glb", "take2_02.GLB", "take2_03.gltf", "take2_03.bin"),
        ("1.stl", "2.off", "3.ply"),
        ("000001.ply", "._000001.ply", ".000009.ply", "000002.ply", "000003.ply", "Thumbs.db", "notes.txt"),
        ("000001.ply", "000002.ply", "000003.ply", "reference.ply", "old/000007.ply"),
        ("000001.ply", "000001.obj", "1.ply", "000002.ply", "000003.ply"),
    ],
)
def test_what_is_checked_is_what_is_taken(names: tuple[str, ...], tmp_path: Path):
    folder = capture_with(tmp_path, *names)
    capture, take = read_capture(folder), open_take(folder)
    assert capture.frame_ids == tuple(take.files) == (1, 2, 3)
    assert [scan_path(capture, frame_id) for frame_id in capture.frame_ids] == list(take.files.values())
    assert take.facts.duplicated == ((1,) if "000001.obj" in names else ())


def test_of_several_files_the_first_kind_counts_and_there_the_first_name(tmp_path: Path):
    assert set(KINDS) == set(READABLE)
    found = list_scans(capture_with(tmp_path, "1.obj", "01.ply", "001.PLY", "0001.glb") / "scans")
    assert found.scans[1].name == "001.PLY"
    assert [path.name for path in found.also[1]] == ["01.ply", "0001.glb", "1.obj"]


def test_a_pattern_says_which_number(tmp_path: Path):
    folder = capture_with(tmp_path, "c1_0005_9.ply", "c1_0006_9.PLY", "other_7.ply")
    assert list(open_take(folder, Claims(frames="c1_{frame}_9.ply")).files) == [5, 6]


def test_numbers_beyond_int32_are_said(tmp_path: Path):
    folder = capture_with(tmp_path, "99999999999.ply")
    for opened in (read_capture, open_take):
        with pytest.raises(InputError, match="frame numbers up to 2147483647 in the names of scans, found 99999999999"):
            opened(folder)


def test_folders_pipes_and_broken_links_are_no_scans(tmp_path: Path):
    folder = capture_with(tmp_path, "000001.ply", "000004.ply/within.txt")
    (folder / "scans" / "000002.ply").symlink_to("nowhere.ply")
    (folder / "scans" / "000009.ply").symlink_to("000009.ply")
    os.mkfifo(folder / "scans" / "000003.ply")
    (folder / "scans" / "again").symlink_to(folder / "scans")
    assert list(list_scans(folder / "scans").scans) == [1]
    with pytest.raises(InputError, match=r"scans: expected scans with a frame number in their names .*found none"):
        read_capture(capture_with(tmp_path / "other"))


def test_a_capture_made_in_python_finds_its_scans(tmp_path: Path):
    write_mesh(tmp_path / "scans" / "frame_7.ply", SQUARE, colours=COLOURS)
    made = Capture(tmp_path, "take", 60.0, (7,), None)
    assert scan_path(made, 7).name == "frame_7.ply"


def test_points_are_read_as_a_surface_and_said_to_be(tmp_path: Path):
    mesh = tube(60, 40)
    colours = np.full((len(mesh.vertices), 3), 99, np.uint8)
    for frame_id, suffix, faces in ((1, ".ply", False), (2, ".obj", False), (3, ".ply", True)):
        shown = Mesh(mesh.vertices, mesh.faces if faces else mesh.faces[:0])
        write_mesh(tmp_path / "scans" / f"{frame_id}{suffix}", shown, colours=colours)
    write_json(tmp_path / "capture.json", {"format": 1, "fps": 60})
    capture = read_capture(tmp_path)
    found = [read_frame(capture, frame_id) for frame_id in capture.frame_ids]
    assert [estimated for _, estimated in found] == [True, True, False]
    for scan, _ in found:
        assert len(scan.mesh.faces) == pytest.approx(len(mesh.faces), rel=0.01)
        np.testing.assert_array_equal(scan.colours, colours)


def test_across_a_seam_both_sides_show_one_colour(tmp_path: Path):
    mesh = tube(12, 5)
    corners = mesh.faces.reshape(-1)
    parts = Mesh(mesh.vertices[corners], np.arange(len(corners), dtype=np.int32).reshape(-1, 3))
    colours = np.random.default_rng(0).integers(0, 256, (len(corners), 3)).astype(np.uint8)
    write_mesh(tmp_path / "1.ply", parts, colours=colours)
    found = read_surface(tmp_path / "1.ply")
    assert len(found.mesh.vertices) == len(mesh.vertices)
    assert found.colours is not None
    for vertex in range(0, len(mesh.vertices), 7):
        at = (mesh.vertices[corners] == found.mesh.vertices[vertex]).all(axis=1)
        np.testing.assert_allclose(found.colours[vertex], colours[at].mean(axis=0), atol=0.51)
