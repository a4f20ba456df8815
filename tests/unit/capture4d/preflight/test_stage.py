"""The preflight check on a figure of capsules: sound, and with one thing wrong at a time."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.body.anny import load_anny
from capture4d.body.skinning import pose_frame, with_shape
from capture4d.captures.capture import read_capture, read_frame
from capture4d.captures.placement import Placement, place, place_rig
from capture4d.cli.main import main
from capture4d.colours.spaces import to_lab
from capture4d.errors import InputError
from capture4d.files.atomic import write_json
from capture4d.files.records import load_poses, save_body, save_garment, save_poses
from capture4d.mesh_files.meshes import read_coloured_mesh, read_mesh, write_mesh
from capture4d.mesh_files.textures import mean_at_vertices, sampled
from capture4d.motions.retargeting import pose_sequence
from capture4d.preflight.facts import BadFrame, Paints, TakeFacts
from capture4d.preflight.findings import ADVICE, CODES
from capture4d.preflight.mannequin import upright
from capture4d.preflight.statistics import (
    FrameStatistics,
    hole_share,
    measure_frame,
    outwardness,
    surface_noise,
    surface_shift,
)
from capture4d.preflight.survey import find_units
from capture4d.preflight.take_folder import open_take, time_stamp
from capture4d.preflight.verdict import judge
from capture4d.types import Garment, Mesh, Rig, Scan
from tests.command_line import fails, run
from tests.shapes import ring

BLUE, YELLOW, GREY = (47, 98, 201), (255, 196, 0), (150, 152, 156)
PAINTS = Paints(BLUE, (YELLOW,))


def sphere(radius: float = 1.0, subdivisions: int = 4) -> Mesh:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return Mesh(np.asarray(ball.vertices, np.float32), np.asarray(ball.faces, np.int32))


def figure(raised_deg: float) -> Scan:
    """A person of capsules with one arm raised: blue trunk with a yellow band near its lower end, the rest grey."""
    import trimesh

    arm = np.radians(raised_deg - 70)
    bones = [((0, 1.56, 0.01), (0, 1.62, 0.01), 0.09), ((0, 1.42, 0), (0, 1.5, 0), 0.055)]
    bones += [((x, 0.98, 0), (x, 1.33, 0), 0.11) for x in (-0.08, 0.0, 0.08)]
    for side in (-1, 1):
        bones += [
            ((side * 0.1, 0.88, 0), (side * 0.1, 0.06, 0), 0.06),
            ((side * 0.1, 0.04, 0), (side * 0.1, 0.04, 0.16), 0.035),
        ]
        hand = (0.18 + 0.6 * np.cos(arm), 1.39 + 0.6 * np.sin(arm), 0) if side > 0 else (-0.4, 0.82, 0.05)
        bones.append(((side * 0.18, 1.39, 0), hand, 0.04))
    vertices, faces, colours, count = [], [], [], 0
    for number, (start, end, radius) in enumerate(bones):
        a, b = np.array(start), np.array(end)
        limb = trimesh.creation.capsule(height=float(np.linalg.norm(b - a)), radius=radius, count=(12, 8))
        limb = limb.subdivide_to_size(0.035)
        limb.apply_transform(trimesh.geometry.align_vectors((0, 0, 1), (b - a) / np.linalg.norm(b - a)))
        points = np.asarray(limb.vertices) + a
        vertices.append(points)
        faces.append(np.asarray(limb.faces) + count)
        trunk = number in (2, 3, 4)
        height = points[:, 1:2]
        band = np.where(height < 0.94, GREY, np.where(height < 0.97, YELLOW, BLUE))
        paint = band if trunk else np.tile(GREY, (len(points), 1))
        colours.append(paint)
        count += len(points)
    mesh = Mesh(np.concatenate(vertices).astype(np.float32), np.concatenate(faces).astype(np.int32))
    return Scan(mesh, np.concatenate(colours).astype(np.uint8), 0, 0.0)


@pytest.fixture(scope="module")
def sound() -> dict[int, Scan]:
    return {number: replace(figure(12.0 * number), frame_id=number) for number in range(10, 15)}


def write(folder: Path, scans: dict[int, Scan], suffix: str = ".ply", **description: object) -> Path:
    for number, scan in scans.items():
        write_mesh(folder / "scans" / f"{number:06d}{suffix}", scan.mesh, colours=scan.colours)
    told = {
        "format": 1,
        "name": "figure",
        "fps": 30.0,
        "garment_colour": "#2f62c9",
        "boundary_colours": {"hem": "#ffc400"},
    }
    write_json(folder / "capture.json", {**told, **description})
    return folder


def moved(scans: dict[int, Scan], matrix: np.ndarray, shift: tuple[float, float, float] = (0, 0, 0)) -> dict[int, Scan]:
    def change(mesh: Mesh) -> Mesh:
        return mesh.with_vertices((mesh.vertices @ matrix.T + shift).astype(np.float32))

    return {number: replace(scan, mesh=change(scan.mesh)) for number, scan in scans.items()}


def opened(mesh: Mesh) -> Mesh:
    """With a border, as a garment has; no vertex is lost."""
    return Mesh(mesh.vertices, mesh.faces[1:])


def check(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, dict]:
    capsys.readouterr()
    with pytest.raises(SystemExit) as exit_:
        main(["check", *map(str, arguments), "--json", "--workers", "1"])
    return int(exit_.value.code or 0), json.loads(capsys.readouterr().out)


def codes(found: dict) -> list[str]:
    return [finding["code"] for finding in found["findings"]]


# --- measures, against what is known exactly


def test_a_sphere_looks_outwards_and_inside_out_inwards():
    ball = sphere()
    assert outwardness(ball) == pytest.approx(1.0, abs=0.01)
    assert outwardness(Mesh(ball.vertices, ball.faces[:, ::-1].copy())) == pytest.approx(-1.0, abs=0.01)


def test_noise_is_that_of_the_plane_whatever_its_scale():
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(40.0), np.arange(40.0))
    flat = np.stack([x.ravel(), y.ravel(), np.zeros(1600)], 1)
    index = np.arange(1600).reshape(40, 40)
    a, b, c = index[:-1, :-1].ravel(), index[:-1, 1:].ravel(), index[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, b + 40, c], 1)]).astype(np.int32)
    rough = flat + (0, 0, 0.3) * rng.standard_normal((1600, 1))
    assert surface_noise(Mesh(flat.astype(np.float32), faces)) < 1e-3
    levels = [surface_noise(Mesh((scale * rough).astype(np.float32), faces)) for scale in (0.001, 1.0)]
    assert levels[0] == pytest.approx(levels[1], rel=1e-3)
    assert levels[0] > 0.12


def test_a_hole_counts_with_its_area():
    ball = sphere(0.3)
    assert hole_share(ball) == 0.0
    open_ball = Mesh(ball.vertices, ball.faces[~(ball.vertices[ball.faces][:, :, 1] > 0.29).any(axis=1)])
    cap = 2 * np.pi * 0.3 * 0.01
    assert hole_share(open_ball) == pytest.approx(cap / (4 * np.pi * 0.09), rel=0.3)


def test_a_shift_is_measured_across_the_surface():
    ball = sphere(0.3)
    assert surface_shift(ball, ball) == pytest.approx(0.0, abs=1e-6)
    grown = ball.with_vertices(ball.vertices * np.float32(1.02))
    assert surface_shift(ball, grown) == pytest.approx(0.006, rel=0.05)


@pytest.mark.parametrize(("distance", "wrong"), [(0.0, False), (0.5, False), (2.0, True), (4.0, True)])
def test_a_subject_beside_the_rig_is_outside(distance: float, wrong: bool):
    rig, frames = ring(), []
    for number in range(1, 5):
        scan = figure(12.0 * number)
        mesh = scan.mesh.with_vertices(scan.mesh.vertices + np.array([0.6, 0, 0.8], np.float32) * distance)
        frames.append(measure_frame(replace(scan, mesh=mesh, frame_id=number), PAINTS, rig=rig))
    assert judged(frames) == ([("outside-volume", (1, 2, 3, 4))] if wrong else [])


def test_a_rig_moves_with_its_scans():
    rng = np.random.default_rng(1)
    T = np.eye(4)
    T[:3, 3] = 0.1, -0.2, 2.0
    rig = Rig(("a",), np.eye(3)[None], np.zeros((1, 5)), T[None], np.array([[9, 9]], np.int32))
    placement = Placement(0.01, upright(2), lift_m=0.4)
    points = rng.random((5, 3))
    placed = 0.01 * points @ placement.axes.T + (0, 0.4, 0)
    there = place_rig(rig, placement, scale=0.01).T_camera_world[0]
    np.testing.assert_allclose(
        placed @ there[:3, :3].T + there[:3, 3], 0.01 * (points @ T[:3, :3].T + T[:3, 3]), atol=1e-12
    )


@pytest.mark.parametrize("up", range(6))
def test_upright_is_a_rotation_that_takes_the_axis_to_y(up: int):
    direction = np.eye(3)[up % 3] * (-1 if up > 2 else 1)
    np.testing.assert_array_equal(upright(up) @ direction, (0, 1, 0))
    assert np.linalg.det(upright(up)) == pytest.approx(1)


@pytest.mark.parametrize(("unit", "metres"), [("m", 1.0), ("cm", 0.01), ("mm", 0.001), ("in", 0.0254)])
@pytest.mark.parametrize("size_m", [0.95, 1.5])
def test_units_of_shirts_and_of_whole_people(unit: str, metres: float, size_m: float):
    assert find_units(size_m / metres)[0] == unit


def test_placing_a_mirrored_mesh_back_makes_it_look_outwards():
    ball = sphere()
    mirror = np.diag([-1.0, 1, 1])
    mirrored = ball.with_vertices((ball.vertices @ mirror.T).astype(np.float32))
    assert outwardness(place(mirrored, Placement(axes=mirror))) == pytest.approx(1, abs=0.01)


def test_lab_of_the_primaries():
    expected = [[53.24, 80.09, 67.20], [87.73, -86.18, 83.18], [100.0, 0, 0]]  # CIE, sRGB red, green, white under D65
    found = to_lab(np.array([[255, 0, 0], [0, 255, 0], [255, 255, 255]], np.uint8))
    np.testing.assert_allclose(found, expected, atol=0.05)


# --- textures


def test_a_texture_of_a_ramp_gives_the_ramp_at_the_vertices(tmp_path: Path):
    from PIL import Image

    ramp = np.zeros((2, 256, 3), np.uint8)
    ramp[:, :, 0] = np.arange(256)
    ramp[0, :, 1] = 200
    u = (np.array([10, 200, 100]) + 0.5) / 256
    mesh = Mesh(
        np.eye(3, dtype=np.float32),
        np.array([[0, 1, 2]], np.int32),
        np.stack([u, [0.9, 0.1, 0.9]], 1)[None].astype(np.float32),
    )
    expected = [[10, 200, 0], [200, 0, 0], [100, 200, 0]]
    corners = sampled(ramp, mesh.uv.reshape(-1, 2))
    found = mean_at_vertices(mesh.faces.reshape(-1), corners, len(mesh.vertices))
    np.testing.assert_array_equal(found, expected)
    write_mesh(tmp_path / "scan.obj", mesh)
    Image.fromarray(ramp).save(tmp_path / "skin.png")
    (tmp_path / "scan.mtl").write_text("newmtl skin\nmap_Kd skin.png\n")
    text = (tmp_path / "scan.obj").read_text()
    (tmp_path / "scan.obj").write_text(f"mtllib scan.mtl\n{text}")
    np.testing.assert_array_equal(read_coloured_mesh(tmp_path / "scan.obj").colours, expected)


# --- judgement


def frame(number: int, **changes: Any) -> FrameStatistics:
    base = measure_frame(replace(figure(0), frame_id=number), PAINTS) if not FRAME else FRAME[0]
    FRAME[:] = [base]
    return replace(base, frame_id=number, content=str(number), **changes)


FRAME: list[FrameStatistics] = []


def judged(
    frames: list[FrameStatistics], bad: tuple[BadFrame, ...] = (), **facts: Any
) -> list[tuple[str, tuple[int, ...]]]:
    told = TakeFacts(fps=30.0, declared=1.0, paints=PAINTS, frame_ids=tuple(f.frame_id for f in frames))
    verdict = judge(replace(told, **facts), None, frames, bad)
    return [(finding.code, finding.frames) for finding in verdict.findings]


def test_every_code_has_advice():
    assert set(ADVICE) == set(CODES)


def test_sound_frames_are_judged_sound_at_any_regular_step():
    assert judged([frame(number) for number in range(7, 60, 5)]) == []


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"noise": 0.3}, "noise"),
        ({"hole_share": 0.5}, "holes"),
        ({"area_m2": 0.8}, "frame-partial"),
        ({"content": "1"}, "frame-repeated"),
        ({"colours": None}, "colours-missing"),
        ({"notes": ("scans/000005.obj: 3 corners have no UVs",)}, "read-in-part"),
        ({"pose_distance_m": 0.08}, "poses-mismatch"),
    ],
)
def test_one_bad_frame_is_named(changes: dict, code: str):
    frames = [frame(number) for number in range(1, 9)]
    frames[4] = replace(frames[4], **changes)
    assert judged(frames) == [(code, (5,))]


def test_a_scaled_frame_is_named_and_a_cropped_one_is_not_scaled():
    frames = [frame(number) for number in range(1, 9)]
    frames[2] = replace(frames[2], area_m2=frames[2].area_m2 * 1.21, spacing_m=frames[2].spacing_m * 1.1)
    frames[5] = replace(frames[5], area_m2=frames[5].area_m2 * 0.8)
    assert judged(frames) == [("scale-jump", (3,))]


def test_numbers_tell_what_is_missing():
    frames = [frame(number) for number in (2, 4, 6, 10, 12)]
    assert judged(frames) == [("frames-missing", (8,))]
    assert judged(frames, dropped=(8,)) == []
    assert judged(frames, dropped=(8,), listed=(2, 3)) == [("frames-listed", (3,))]
    assert judged(frames, dropped=(8,), duplicated=(4,)) == [("frames-duplicated", (4,))]
    assert judged(frames, dropped=(8,), pose_frames=(2, 4, 6, 10)) == [("poses-missing", (12,))]


@pytest.mark.parametrize(("fps", "shift", "wrong"), [(30, 0.02, False), (30, 0.15, True), (0.03, 0.02, True)])
def test_speed_tells_the_rate(fps: float, shift: float, wrong: bool):
    frames = [frame(number, shift_m=shift, shift_from=number - 1) for number in range(1, 9)]
    assert judged(frames, fps=float(fps)) == ([("fps", ())] if wrong else [])


def test_time_stamps_and_motion_capture_tell_the_rate():
    frames = [frame(number, time_s=number / 60) for number in range(1, 9)]
    assert judged(frames) == [("fps", ())]
    assert judged(frames, fps=60.0) == []
    assert judged([frame(number) for number in range(1, 9)], pose_fps=60.0) == [("fps", ())]


# --- the command


def test_a_sound_take_is_clean(sound: dict[int, Scan], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    code, found = check(capsys, write(tmp_path / "take", sound))
    assert (code, found["status"], found["findings"]) == (0, "clean", [])
    keys = {"format", "capture", "status", "frames", "frames_checked", "colours", "findings", "scores", "fixed"}
    assert set(found) == keys | {"unlisted"}
    assert found["colours"] == "given"
    assert set(found["scores"]) <= set(CODES)
    assert all(0 <= score <= 1 for score in found["scores"].values())


def test_warnings_are_a_bad_result_for_the_strict_alone(
    sound: dict[int, Scan], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    take = write(tmp_path / "take", {number: scan for number, scan in sound.items() if number != 12})
    code, found = check(capsys, take)
    assert (code, codes(found), found["findings"][0]["frames"]) == (0, ["frames-missing"], [12])
    assert check(capsys, take, "--strict")[0] == 3


TURN = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


@pytest.mark.parametrize(
    ("matrix", "shift", "wrong"),
    [
        (1000 * np.eye(3), (0, 0, 0), "units"),
        (TURN, (0, 0, 0), "axes"),
        (np.diag([-1.0, 1, 1]), (0, 0, 0), "winding"),
        (np.eye(3), (0, 0.4, 0), "floor"),
    ],
)
def test_a_fixed_take_is_clean_and_the_original_untouched(
    matrix: np.ndarray,
    shift: tuple[float, float, float],
    wrong: str,
    sound: dict[int, Scan],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    take = write(tmp_path / "take", moved(sound, matrix, shift))

    def digest() -> dict[Path, bytes]:
        return {p: hashlib.sha256(p.read_bytes()).digest() for p in sorted(take.rglob("*.*"))}

    before = digest()
    code, found = check(capsys, take, "--fix")
    assert codes(found) == [wrong]
    assert code == (0 if wrong == "floor" else 3)
    assert found["fixed"] == str(tmp_path / "take-fixed")
    assert digest() == before
    assert check(capsys, tmp_path / "take-fixed")[1]["findings"] == []
    if wrong != "winding":
        fixed = read_mesh(tmp_path / "take-fixed" / "scans" / "000011.ply").mesh
        # The floor is known to a few centimetres; everything else exactly.
        np.testing.assert_allclose(fixed.vertices, sound[11].mesh.vertices, atol=0.04 if wrong == "floor" else 1e-4)


@pytest.mark.parametrize("brings_body", [True, False])
def test_poses_are_fixed_with_the_scans_whose_floor_they_share(
    brings_body: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    body = load_anny()
    person = with_shape(body, np.array([0.5, -0.5], np.float32))
    rotations = np.tile(np.eye(3), (5, len(body.joint_names), 1, 1))
    for row in range(5):
        turn = Rotation.from_euler("z", 6 * row, degrees=True).as_matrix()
        rotations[row, body.joint_names.index("upperarm01.L")] = turn
    poses = pose_sequence(person, rotations, 30.0)
    poses = replace(poses, translations=poses.translations + np.array([0, 0.4, 0], np.float32))
    trunk = np.isin(body.skin_weights.argmax(axis=1), [body.joint_names.index(f"spine0{k}") for k in range(1, 6)])
    scans = {}
    for row in range(5):
        mesh = body.template.with_vertices(pose_frame(person, poses, row).vertices().astype(np.float32))
        scans[row] = Scan(mesh, np.where(trunk[:, None], BLUE, GREY).astype(np.uint8), row, 0.0)
    take = write(tmp_path / "take", scans, boundary_colours={})
    save_poses(take / "poses.npz", poses)
    if brings_body:
        save_body(take / "body.npz", body)
    found = check(capsys, take, "--fix")[1]
    assert {"floor"} == set(codes(found)) - {"noise", "holes"}
    moved = load_poses(tmp_path / "take-fixed" / "poses.npz").translations - poses.translations
    np.testing.assert_allclose(moved, np.tile([0, -0.4, 0], (5, 1)), atol=0.01)
    assert not {"floor", "poses-mismatch"} & set(codes(check(capsys, tmp_path / "take-fixed")[1]))


def test_a_killed_fix_is_repeated_and_lies_beside_the_take(
    sound: dict[int, Scan], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    take = write(tmp_path / "take", moved(sound, 1000 * np.eye(3)))

    def die(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.chdir(take)
    with monkeypatch.context() as patched:
        patched.setattr("capture4d.preflight.repair.fix._copy_companions", die)
        with pytest.raises(SystemExit) as exit_:
            main(["check", ".", "--fix", "--workers", "1"])
        assert exit_.value.code == 130
    assert not (tmp_path / "take-fixed").exists()
    assert check(capsys, ".", "--fix")[1]["fixed"] == str(tmp_path / "take-fixed")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["take", "take-fixed"]
    assert sorted(path.name for path in take.iterdir()) == ["capture.json", "scans"]


def test_only_what_changes_is_written_anew(sound: dict[int, Scan], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """A frame rate is one line of capture.json; the scans stay what they are."""
    frames, paints = [9, *sound], {"border_0": "#ffc400"}
    take = write(tmp_path / "take", moved(sound, 100 * np.eye(3)), units="cm", frames=frames, boundary_colours=paints)
    (take / "scans" / "000012.ply").rename(take / "scans" / "Scan0012.PLY")
    write_mesh(take / "template.obj", opened(moved({0: sound[10]}, 100 * np.eye(3))[0].mesh))
    target = tmp_path / "elsewhere" / "good"
    _, found = check(capsys, take, "--fix", "--output", target)
    assert codes(found) == ["frames-listed"]
    assert found["fixed"] == str(target)
    fixed = read_capture(target)
    assert (fixed.units, fixed.frame_ids) == ("cm", tuple(sound))
    for number in sound:
        name = "Scan0012.PLY" if number == 12 else f"{number:06d}.ply"
        assert (target / "scans" / f"{number:06d}.ply").samefile(take / "scans" / name)
    np.testing.assert_allclose(fixed.template.template.vertices, sound[10].mesh.vertices, atol=1e-5)
    assert not list(target.parent.glob(".*")), "nothing else is left"
    assert not (target / "fix.json").exists()


def test_scans_are_copied_where_there_are_no_links(
    sound: dict[int, Scan], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    def none(*_: object, **__: object) -> None:
        raise OSError(18, "Invalid cross-device link")

    take = write(tmp_path / "take", sound, frames=[9, *sound])
    monkeypatch.setattr("os.link", none)
    with pytest.raises(SystemExit):
        main(["check", str(take), "--fix", "--workers", "1"])
    assert f"corrected: {tmp_path / 'take-fixed'} (scans: 5 copied)" in " ".join(capsys.readouterr().out.split())
    for number in sound:
        copied, scan = (folder / "scans" / f"{number:06d}.ply" for folder in (tmp_path / "take-fixed", take))
        assert copied.read_bytes() == scan.read_bytes()


def test_textures_go_with_scans_that_stay(sound: dict[int, Scan], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    take = write(tmp_path / "take", sound, frames=[9, *sound])
    (take / "scans" / "images").mkdir()
    (take / "scans" / "images" / "skin.png").write_bytes(b"an image")
    check(capsys, take, "--fix")
    assert (tmp_path / "take-fixed" / "scans" / "images" / "skin.png").samefile(take / "scans" / "images" / "skin.png")


def test_a_fix_goes_on_where_it_was_killed(
    sound: dict[int, Scan], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    take = write(tmp_path / "take", moved(sound, 1000 * np.eye(3)))
    written: list[Path] = []

    def two_at_most(path: Path, *arguments: object, **named: object) -> None:
        if len(written) == 2:
            raise KeyboardInterrupt
        written.append(path)
        write_mesh(path, *arguments, **named)

    with monkeypatch.context() as patched:
        patched.setattr("capture4d.preflight.repair.fix.write_mesh", two_at_most)
        with pytest.raises(SystemExit):
            main(["check", str(take), "--fix", "--workers", "1"])
    assert len(written) == 2
    times = {path.name: path.stat().st_mtime_ns for path in written}
    assert check(capsys, take, "--fix")[1]["fixed"] == str(tmp_path / "take-fixed")
    folder = tmp_path / "take-fixed" / "scans"
    assert {name: (folder / name).stat().st_mtime_ns for name in times} == times
    assert len(list(folder.iterdir())) == len(sound)
    assert check(capsys, tmp_path / "take-fixed")[1]["findings"] == []


def test_where_a_fix_goes_is_looked_at_first(
    sound: dict[int, Scan], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    take = write(tmp_path / "take", sound)
    (tmp_path / "take-fixed").mkdir()

    def look(*_: object, **__: object) -> None:
        raise AssertionError("looked at frames first")

    monkeypatch.setattr("capture4d.preflight.stage.check_take", look)
    assert "already there" in fails(capsys, "check", take, "--fix")
    assert "expected a folder outside the take" in fails(capsys, "check", take, "--fix", "--output", take / "better")
    assert "--output: expected --fix with it" in fails(capsys, "check", take, "--output", tmp_path / "new")


def test_names_of_paints_are_held_to_the_template(
    sound: dict[int, Scan], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    few = {number: sound[number] for number in (10, 11, 12)}
    take = write(tmp_path / "take", few, boundary_colours={"bottom": "#ffc400"})
    mesh = sound[10].mesh
    assert codes(check(capsys, take)[1]) == [], "the template may come later"
    save_garment(take / "template.npz", Garment(opened(mesh), {"hem": mesh.faces[0]}))
    code, found = check(capsys, take, "--fix")
    assert (code, codes(found)) == (3, ["borders-named"])
    assert "paints named bottom; the template's borders are hem" in found["findings"][0]["found"]
    assert set(read_capture(tmp_path / "take-fixed").boundary_colours) == {"hem"}
    assert codes(check(capsys, tmp_path / "take-fixed")[1]) == []
    write(take, {}, boundary_colours={"border": "#ffc400"})
    assert codes(check(capsys, take)[1]) == [], "a paint that is on any border"
    (take / "template.npz").write_bytes(b"no template")
    (finding,) = check(capsys, take)[1]["findings"]
    assert (finding["code"], finding["severity"]) == ("template", "error")
    assert "template.npz" in finding["found"]


def test_files_that_no_stage_takes_are_named(
    sound: dict[int, Scan], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    take = write(tmp_path / "take", sound, frames=[10, 11, 12], dropped_frames=[13])
    write_mesh(take / "scans" / "calibration.ply", sound[10].mesh)
    code, found = check(capsys, take)
    assert (code, codes(found)) == (0, [])
    assert found["unlisted"] == ["000014.ply", "calibration.ply"], "13 is said to be left out"
    assert run("check", take, "--workers", "1") == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "Beside the frames, taken by no stage: 2 files, 000014.ply, calibration.ply" in said


def test_a_bare_template_is_placed_as_the_scans_are(
    sound: dict[int, Scan], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    take = write(tmp_path / "take", moved(sound, 1000 * TURN), boundary_colours={"border_0": "#ffc400"})
    for scan in moved({0: sound[10]}, 1000 * TURN).values():
        write_mesh(take / "template.obj", opened(scan.mesh))
    assert set(codes(check(capsys, take, "--fix")[1])) == {"units", "axes"}
    fixed = read_mesh(tmp_path / "take-fixed" / "template.obj").mesh
    np.testing.assert_allclose(fixed.vertices, sound[10].mesh.vertices, atol=1e-4)
    np.testing.assert_array_equal(fixed.faces, opened(sound[10].mesh).faces)


def test_what_the_command_line_says_is_kept(sound: dict[int, Scan], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    take = write(tmp_path / "take", moved(sound, 1000 * np.eye(3)), garment_colour=None, boundary_colours={})
    options = ("--garment-colour", "2f62c9", "--border-colour", "#FFC400", "--fps", "25")
    check(capsys, take, "--fix", *options)
    description = json.loads((tmp_path / "take-fixed" / "capture.json").read_text())
    assert description["garment_colour"] == "#2f62c9"
    assert description["boundary_colours"] == {"border": "#ffc400"}
    assert description["fps"] == 25


def test_a_time_stamp_that_is_a_date_tells_nothing(tmp_path: Path):
    path = tmp_path / "1.ply"
    for text, seconds in (("time 1.25", 1.25), ("time 2023-05-01", None), ("timestamp ...", None), ("nothing", None)):
        path.write_text(f"ply\ncomment {text}\nend_header\n")
        assert time_stamp(path) == seconds


def test_unusable_frames_are_left_out(sound: dict[int, Scan], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    take = write(tmp_path / "take", sound)
    whole = (take / "scans" / "000011.ply").read_bytes()
    (take / "scans" / "000011.ply").write_bytes(whole[: len(whole) // 2])
    (take / "scans" / "000013.ply").write_bytes(b"")
    code, found = check(capsys, take, "--fix")
    assert (code, codes(found)) == (3, ["frame-unreadable", "frame-empty"])
    description = json.loads((tmp_path / "take-fixed" / "capture.json").read_text())
    assert description["frames"] == [10, 12, 14]
    assert description["dropped_frames"] == [11, 13]
    assert check(capsys, tmp_path / "take-fixed")[0] == 0


def test_a_folder_of_scans_is_enough(sound: dict[int, Scan], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for number, scan in sound.items():
        write_mesh(tmp_path / f"take_{number}_v2.ply", scan.mesh, colours=scan.colours)
    command = (tmp_path, "--pattern", "take_{frame}_v2.ply")
    code, found = check(capsys, *command, "--garment-colour", "#2f62c9")
    assert (code, found["frames"], found["colours"]) == (0, 5, "given")
    assert check(capsys, *command)[1]["colours"] == "learned"
    with pytest.raises(SystemExit):
        main(["check", *map(str, command), "--workers", "1"])
    assert "will learn the colours from the scans" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("options", "text", "said"),
    [
        (["--pattern", "scan.ply"], None, "expected a file name with {frame} in it once"),
        (["--pattern", "other_{frame}.ply"], None, "expected scans named other_{frame}.ply, found none"),
        ([], "{", "not valid JSON"),
        ([], "[]", "expected a JSON object"),
        ([], '{"fps": -1}', "expected a positive frame rate"),
        ([], '{"units": "furlong"}', "expected units m, cm, mm, in"),
        ([], '{"garment_colour": "blue"}', "expected a colour such as"),
    ],
)
def test_bad_input_is_one_line(
    options: list[str],
    text: str | None,
    said: str,
    sound: dict[int, Scan],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    take = write(tmp_path / "take", {10: sound[10]})
    if text is not None:
        (take / "capture.json").write_text(text)
    with pytest.raises(SystemExit) as exit_:
        main(["check", str(take), *options])
    err = capsys.readouterr().err
    assert exit_.value.code == 1
    assert said in err
    assert err.count("\n") == 1


def test_nothing_there_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for folder, said in ((tmp_path / "none", "found nothing"), (tmp_path, "found none")):
        with pytest.raises(SystemExit) as exit_:
            main(["check", str(folder)])
        assert exit_.value.code == 1
        assert said in capsys.readouterr().err


def test_the_frames_that_are_listed_are_those_of_the_stages(
    sound: dict[int, Scan], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Scans beside them are not looked at, nor written, nor missed."""
    take = write(tmp_path / "take", sound, frames=[10, 11, 13])
    (take / "scans" / "000012.ply").write_bytes(b"")
    (take / "scans" / "14.ply").write_bytes(b"")
    code, found = check(capsys, take)
    assert (code, codes(found), found["frames"]) == (0, [], 3)
    write_mesh(take / "scans" / "13.ply", sound[13].mesh, colours=sound[13].colours)
    assert codes(check(capsys, take, "--fix")[1]) == ["frames-duplicated"]
    assert read_capture(take).frame_ids == read_capture(tmp_path / "take-fixed").frame_ids == (10, 11, 13)
    (take / "scans" / "000011.ply").unlink()
    finding = next(each for each in check(capsys, take)[1]["findings"] if each["code"] == "frames-listed")
    assert (finding["severity"], finding["frames"]) == ("error", [11])
    with pytest.raises(InputError, match=r"000011\.ply: no such scan; 1 of 3 frames"):
        read_capture(take)
    for name in ("000010", "000013", "13"):
        (take / "scans" / f"{name}.ply").unlink()
    with pytest.raises(InputError, match=r"scans: expected scans of the frames in capture\.json, found 2 others"):
        open_take(take)


def test_what_could_not_be_used_of_a_file_is_told(
    sound: dict[int, Scan], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    take = write(tmp_path / "take", sound)
    scan, target = take / "scans" / "000012.ply", take / "scans" / "000012.obj"
    found = read_coloured_mesh(scan)
    scan.unlink()
    write_mesh(target, found.mesh, colours=found.colours)
    first, _, rest = target.read_text().partition("\n")
    target.write_text(" ".join([*first.split()[:4], "nan", "nan", "nan"]) + "\n" + rest)
    code, report = check(capsys, take)
    (finding,) = report["findings"]
    assert (code, finding["code"], finding["severity"], finding["frames"]) == (0, "read-in-part", "warning", [12])
    count = len(found.mesh.vertices)
    assert f"000012.obj: 1 of {count} colours are no numbers: black" in finding["found"]
    (take / "scans" / "13.ply").write_bytes((take / "scans" / "000013.ply").read_bytes())
    check(capsys, take, "--fix")
    assert read_capture(tmp_path / "take-fixed").frame_ids == tuple(sound), "a frame in part is a frame"


@pytest.mark.parametrize("borders", [None, {"../x": "ffc400"}])
def test_what_the_command_line_says_replaces_what_was_wrong(
    borders: object, sound: dict[int, Scan], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """The corrected take can be read, with clouds as clouds, under names that were not its files'."""
    clouds = {
        number: replace(scan, mesh=Mesh(scan.mesh.vertices, scan.mesh.faces[:0])) for number, scan in sound.items()
    }
    take = write(tmp_path / "take", clouds, boundary_colours=borders, name=None, fps="fast")
    (take / "scans" / "000012.ply").rename(take / "scans" / "12_.PLY")
    write_mesh(take / "template.PLY", sound[10].mesh)
    _, found = check(capsys, take, "--fix", "--border-colour", "ffc400", "--fps", "30", "--garment-colour", "2f62c9")
    assert "faces-missing" in codes(found)
    fixed = read_capture(tmp_path / "take-fixed")
    assert set(fixed.boundary_colours.values()) == {YELLOW}
    assert (fixed.frame_ids, fixed.fps) == ((10, 11, 12, 13, 14), 30.0)
    assert read_frame(fixed, 12)[1], "what was guessed is not made a fact"
    assert len(fixed.template.template.vertices)
