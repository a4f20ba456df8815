"""The capture folder: what is written is read, and what is wrong is named."""

import json
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.simulated_views import calibration_rig
from capture4d.captures.capture import (
    Capture,
    read_capture,
    read_scan,
    scan_path,
    write_capture_description,
    write_scan,
)
from capture4d.captures.truth import (
    TruthFrame,
    TruthModel,
    read_truth_frame,
    read_truth_model,
    read_truth_vertices,
    write_truth_frame,
    write_truth_model,
)
from capture4d.colours.spaces import format_colour, parse_colour
from capture4d.errors import InputError
from capture4d.files.atomic import write_npz
from capture4d.files.records import load_body, load_garment, load_rig, save_body, save_garment, save_poses, save_rig
from capture4d.geometry.mesh import boundary_loops
from capture4d.mesh_files.meshes import write_mesh
from capture4d.types import Body, Garment, Mesh, PoseSequence, Scan
from tests.shapes import tube

FRAMES = (11, 12, 15)
SQUARE = Mesh(
    np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32), np.array([[0, 1, 2], [0, 2, 3]], np.int32)
)
COLOURS = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [9, 8, 7]], np.uint8)


@pytest.fixture
def capture(tmp_path: Path) -> Capture:
    made = Capture(tmp_path, "take", 60.0, FRAMES, (47, 98, 201), {"neck": (255, 210, 0)})
    for frame_id in FRAMES:
        write_scan(tmp_path / "scans" / f"{frame_id:06d}.ply", Scan(SQUARE, COLOURS, frame_id, made.time_s(frame_id)))
    write_capture_description(made)
    return made


def poses_of(frames: tuple[int, ...]) -> PoseSequence:
    count = len(frames)
    return PoseSequence(
        rotations=np.tile(np.eye(3, dtype=np.float32), (count, 2, 1, 1)),
        translations=np.arange(3 * count, dtype=np.float32).reshape(count, 3),
        shape=np.zeros(4, np.float32),
        frame_ids=np.array(frames, np.int32),
        fps=60.0,
        joint_names=("root", "head"),
    )


def test_a_capture_and_its_scans_come_back(capture: Capture):
    found = read_capture(capture.path)
    assert (found.name, found.fps, found.frame_ids, found.garment_colour) == ("take", 60.0, FRAMES, (47, 98, 201))
    assert dict(found.boundary_colours) == {"neck": (255, 210, 0)}
    scan = read_scan(found, 15)
    np.testing.assert_array_equal(scan.mesh.vertices, SQUARE.vertices)
    np.testing.assert_array_equal(scan.colours, COLOURS)
    assert scan.time_s == pytest.approx(4 / 60)


def test_frames_may_be_left_to_the_files(capture: Capture):
    edit_description(capture, lambda entries: entries.pop("frames"))
    assert read_capture(capture.path).frame_ids == FRAMES


def test_millimetres_become_metres(capture: Capture):
    in_mm = replace(capture, units="mm")
    np.testing.assert_allclose(read_scan(in_mm, 11).mesh.vertices, SQUARE.vertices / 1000)


def test_colours_round_trip():
    assert parse_colour("#2f62c9") == parse_colour("2F62C9") == (47, 98, 201)
    assert format_colour((47, 98, 201)) == "#2f62c9"


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda entries: entries.pop("fps"), "expected the entry 'fps'"),
        (lambda entries: entries.update(fps=0), "expected a positive frame rate, found 0"),
        (lambda entries: entries.update(fps="fast"), "fps: expected a number, found 'fast'"),
        (lambda entries: entries.update(format=7), "expected format 1, found 7"),
        (lambda entries: entries.update(units="inch"), "expected units m, cm, mm, in, found 'inch'"),
        (lambda entries: entries.update(garment_colour="blue"), "expected a colour such as #2f62c9, found 'blue'"),
        (lambda entries: entries.update(frames=[12, 11]), "expected ascending frame numbers"),
        (lambda entries: entries.update(boundary_colours=[1]), "capture.json"),
    ],
)
def test_a_wrong_description_names_file_and_entry(capture: Capture, edit: Callable[[dict], object], message: str):
    edit_description(capture, edit)
    with pytest.raises(InputError) as caught:
        read_capture(capture.path)
    assert "capture.json: " in str(caught.value)
    assert message in str(caught.value)


def edit_description(capture: Capture, edit: Callable[[dict], object]) -> None:
    path = capture.path / "capture.json"
    entries = json.loads(path.read_text())
    edit(entries)
    path.write_text(json.dumps(entries))


def test_what_is_missing_is_named(capture: Capture, tmp_path: Path):
    (capture.path / "scans" / "000012.ply").unlink()
    with pytest.raises(InputError, match=r"000012\.ply: no such scan; 1 of 3 frames"):
        read_capture(capture.path)
    with pytest.raises(InputError, match="no such capture folder"):
        read_capture(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"capture\.json: no such file"):
        read_capture(tmp_path / "empty")
    with pytest.raises(InputError, match=r"template\.npz: no such file"):
        _ = capture.template


def test_a_capture_is_as_it_was_when_it_was_opened(capture: Capture):
    save_poses(capture.path / "poses.npz", poses_of(FRAMES))
    opened = read_capture(capture.path)
    assert opened.poses is opened.poses
    (capture.path / "capture.json").write_text("{}")
    travelled = pickle.loads(pickle.dumps(opened))
    assert (travelled.frame_ids, travelled.entries("fps"), scan_path(travelled, 12).name) == (
        FRAMES, {"fps": 60.0}, "000012.ply"
    )  # fmt: skip


def test_frames_of_a_capture_are_chosen_and_the_others_are_not_forgotten(capture: Capture):
    chosen = read_capture(capture.path).choosing("11,13-20")
    assert (chosen.frame_ids, chosen.left_out) == ((11, 15), (12,))
    assert chosen.choosing("15").left_out == (11, 12)
    assert capture.choosing(None) is capture
    with pytest.raises(InputError, match=r"--frames: expected frames that the take has \(11-12,15\), found '13'"):
        capture.choosing("11,13")


def test_what_capture_json_says_is_told_by_entry(capture: Capture):
    two = replace(capture, boundary_colours={"neck": (255, 210, 0), "hem": (255, 210, 0)}, garment_colour=None)
    assert two.entries("units", "garment_colour", "boundary_colours", "paints") == {
        "units": "m", "garment_colour": None, "boundary_colours": {"neck": "#ffd200", "hem": "#ffd200"},
        "paints": ["#ffd200"],
    }  # fmt: skip


def test_of_two_files_of_a_frame_the_ply_counts(capture: Capture):
    write_mesh(capture.path / "scans" / "000012.obj", SQUARE, colours=COLOURS)
    write_mesh(capture.path / "scans" / "13.obj", SQUARE, colours=COLOURS)
    edit_description(capture, lambda entries: entries.update(frames=[12, 13]))
    opened = read_capture(capture.path)
    assert [scan_path(opened, frame_id).name for frame_id in opened.frame_ids] == ["000012.ply", "13.obj"]


def test_a_scan_without_colours_is_named(capture: Capture):
    write_mesh(capture.path / "scans" / "000012.ply", SQUARE)
    with pytest.raises(InputError, match=r"000012\.ply: expected a colour per vertex"):
        read_scan(capture, 12)


def test_poses_come_in_the_order_of_the_scans(capture: Capture):
    assert capture.poses is None
    save_poses(capture.path / "poses.npz", poses_of((15, 11, 99, 12)))
    poses = replace(capture).poses
    assert poses is not None
    assert poses.frame_ids.tolist() == list(FRAMES)
    assert poses.translations[:, 0].tolist() == [3, 9, 0]
    assert poses.joint_names == ("root", "head")


def test_poses_that_do_not_match_the_scans_are_named(capture: Capture):
    save_poses(capture.path / "poses.npz", poses_of((11, 12, 13)))
    with pytest.raises(InputError, match=r"poses\.npz: expected a pose for each of 3 scans.*frame 15 first"):
        _ = capture.poses


@pytest.mark.parametrize("suffix", [".npz", ".obj", ".ply", ".glb"])
def test_a_template_of_any_format_has_a_digest(suffix: str, capture: Capture):
    with pytest.raises(InputError, match="registration needs a template"):
        _ = capture.template_digest
    digests = set()
    for text in ("one", "two"):
        (capture.path / f"template{suffix}").write_text(text)
        digests.add(replace(capture).template_digest)
    assert len(digests) == 2


def test_motion_is_poses_and_the_body_they_move(capture: Capture):
    (capture.path / "body.npz").write_text("one")
    assert capture.motion_digest is None
    (capture.path / "poses.npz").write_text("poses")
    digests = [replace(capture).motion_digest]
    (capture.path / "body.npz").write_text("two")
    digests.append(replace(capture).motion_digest)
    (capture.path / "body.npz").unlink()
    digests.append(replace(capture).motion_digest)
    assert len(set(digests)) == 3


def test_bodies_garments_and_rigs_come_back(tmp_path: Path):
    rng = np.random.default_rng(0)
    weights = rng.random((4, 2), np.float32)
    weights /= weights.sum(axis=1, keepdims=True)
    body = Body(
        template=SQUARE,
        shape_directions=rng.random((3, 4, 3), np.float32),
        joints=rng.random((2, 3), np.float32),
        joint_directions=rng.random((3, 2, 3), np.float32),
        joint_names=("root", "tête"),
        parents=np.array([-1, 0], np.int32),
        skin_weights=weights,
        regions=np.array([0, 1, 2, 3], np.uint8),
    )
    garment = Garment(
        Mesh(SQUARE.vertices, SQUARE.faces, rng.random((2, 3, 2), np.float32)),
        {"hem": np.array([3, 0, 1, 2], np.int32), "cuff_left": np.array([2, 1, 0, 3], np.int32)},
        skin_weights=weights,
    )
    rig = replace(calibration_rig(2, rng=rng), lenses=("brown", "fisheye"))
    save_body(tmp_path / "body.npz", body)
    save_garment(tmp_path / "garment.npz", garment)
    save_rig(tmp_path / "rig.json", rig)
    for made, found in (
        (body, load_body(tmp_path / "body.npz")),
        (garment, load_garment(tmp_path / "garment.npz")),
        (rig, load_rig(tmp_path / "rig.json")),
    ):
        assert_equal(made, found)


def assert_equal(made, found) -> None:
    """Every field alike, to the bit."""
    if hasattr(made, "__dataclass_fields__"):
        for name in made.__dataclass_fields__:
            assert_equal(getattr(made, name), getattr(found, name))
    elif isinstance(made, dict):
        assert made.keys() == found.keys()
        for key in made:
            assert_equal(made[key], found[key])
    elif isinstance(made, np.ndarray):
        assert made.dtype == found.dtype
        np.testing.assert_array_equal(made, found)
    else:
        assert made == found


def test_truth_comes_back(capture: Capture):
    assert read_truth_model(capture) is None
    model = TruthModel(SQUARE, {"hem": np.array([0, 1], np.int32)}, np.zeros(5, np.int32), np.full((5, 3), 1 / 3, "f4"))
    frame = TruthFrame(
        SQUARE.vertices, np.eye(3, dtype=np.float32)[None], np.zeros(3, np.float32), np.zeros(4, np.uint8)
    )
    write_truth_model(capture.path / "truth" / "model.npz", model)
    write_truth_frame(capture.path / "truth" / "000011.npz", frame)
    assert_equal(model, read_truth_model(capture))
    assert_equal(frame, read_truth_frame(capture, 11))
    np.testing.assert_array_equal(read_truth_vertices(capture, 11), SQUARE.vertices)
    with pytest.raises(InputError, match=r"000012\.npz: no such file"):
        read_truth_frame(capture, 12)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"rotations": np.full((1, 3, 3), np.nan, np.float32)}, "rotations: expected finite numbers"),
        ({"translation": np.full(3, np.inf, np.float32)}, "translation: expected finite numbers"),
        ({"vertices": np.zeros((4, 2), np.float32)}, "vertices"),
        ({"labels": np.zeros(4)}, "labels"),
    ],
)
def test_a_true_state_that_is_none_is_one_line(changed: dict[str, np.ndarray], said: str, capture: Capture):
    arrays = {"vertices": SQUARE.vertices, "rotations": np.eye(3, dtype=np.float32)[None],
              "translation": np.zeros(3, np.float32), "labels": np.zeros(4, np.uint8)}  # fmt: skip
    write_npz(capture.path / "truth" / "000011.npz", **(arrays | changed))
    with pytest.raises(InputError, match=rf"truth/000011\.npz: .*{said}"):
        read_truth_frame(capture, 11)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"template_faces": np.full(5, 2, np.int32)}, "template_faces: expected indices from 0 to 1, found 2"),
        ({"template_barycentric": np.full((5, 3), np.nan, np.float32)}, "template_barycentric: expected finite"),
        ({"template_barycentric": np.zeros((4, 3), np.float32)}, "template_barycentric"),
        ({"loop_hem": np.array([0, 4], np.int32)}, r"loops\['hem'\]: expected indices from 0 to 3, found 4"),
    ],
)
def test_a_true_garment_that_is_none_is_one_line(changed: dict[str, np.ndarray], said: str, capture: Capture):
    arrays = {"fine_vertices": SQUARE.vertices, "fine_faces": SQUARE.faces, "loop_hem": np.array([0, 1], np.int32),
              "template_faces": np.zeros(5, np.int32), "template_barycentric": np.zeros((5, 3), "f4")}  # fmt: skip
    write_npz(capture.path / "truth" / "model.npz", **(arrays | changed))
    with pytest.raises(InputError, match=rf"truth/model\.npz: .*{said}"):
        read_truth_model(capture)


def test_a_damaged_or_foreign_archive_is_named(tmp_path: Path):
    path = tmp_path / "body.npz"
    path.write_bytes(b"PK\x03\x04 not really")
    with pytest.raises(InputError, match=r"body\.npz: not a readable npz file"):
        load_body(path)
    np.savez(path, template_vertices=SQUARE.vertices)
    with pytest.raises(InputError, match=r"body\.npz: expected an array 'template_faces'"):
        load_body(path)
    np.savez(path, template_vertices=np.array([object()]))
    with pytest.raises(InputError, match=r"body\.npz: damaged array 'template_vertices'"):
        load_body(path)


def test_a_bare_mesh_is_a_template_with_its_loops(capture: Capture):
    write_mesh(capture.path / "template.obj", SQUARE)
    garment = capture.template
    assert {name: len(loop) for name, loop in garment.loops.items()} == {"border_0": 4}
    assert garment.skin_weights is None


@pytest.mark.parametrize("name", ["template.ply", "template.GLB", "template.obj"])
def test_a_bare_template_is_joined_at_its_seams(name: str, capture: Capture):
    mesh = tube(12, 5)
    parts = Mesh(mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(mesh.faces.size, dtype=np.int32).reshape(-1, 3))
    write_mesh(capture.path / name, parts)
    found = replace(capture).template
    assert {loop: len(vertices) for loop, vertices in found.loops.items()} == {"border_0": 12, "border_1": 12}
    assert len(found.template.vertices) == len(mesh.vertices)


def test_a_template_whose_borders_lead_elsewhere_is_refused(capture: Capture):
    save_garment(capture.path / "template.npz", Garment(SQUARE, {"../hem": boundary_loops(SQUARE.faces)[0]}))
    with pytest.raises(InputError, match=r"template\.npz: name of a border: expected .*found '\.\./hem'"):
        _ = replace(capture).template


def test_the_buffers_of_a_gltf_template_count(capture: Capture):
    (capture.path / "template.gltf").write_text("{}")
    digests = []
    for text in (b"one", b"two"):
        (capture.path / "template.bin").write_bytes(text)
        digests.append(replace(capture).template_digest)
    assert digests[0] != digests[1]


def test_the_truth_of_another_garment_is_refused(capture: Capture):
    zeros = np.zeros((2, 3), np.float32)
    model = TruthModel(SQUARE, {}, np.zeros(2, np.int32), zeros)
    frame = TruthFrame(zeros, np.zeros((1, 3, 3), np.float32), zeros[0], np.zeros(4, np.uint8))
    write_truth_frame(capture.path / "truth" / "000011.npz", frame)
    assert len(read_truth_vertices(capture, 11)) == 2
    with pytest.raises(
        InputError, match=r"truth/000011\.npz: expected 4 finite float32 vertices, found float32 of \(2, 3\)"
    ):
        read_truth_vertices(capture, 11, model=model)
