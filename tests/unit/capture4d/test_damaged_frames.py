"""One bad frame in a take of six: it is flagged, whatever is wrong with it, and the other five are registered."""

import errno
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from capture4d import pipeline
from capture4d.captures import scan_files
from capture4d.captures.capture import Capture, read_capture, read_scan, write_capture_description, write_scan
from capture4d.captures.work_folder import open_work
from capture4d.cli.main import main
from capture4d.errors import InputError
from capture4d.files.records import save_garment
from capture4d.geometry.mesh import boundary_loops
from capture4d.mesh_files.meshes import read_coloured_mesh, write_mesh
from capture4d.types import Garment, Mesh, Scan
from registration.config import GraphConfig, RegistrationConfig
from tests.shapes import tube

BAD = 3
FRAMES = (1, 2, BAD, 4, 5, 6)
CLOTH, PAINT = (47, 98, 201), (255, 210, 0)
QUICK = RegistrationConfig(graph=GraphConfig(nodes=20))


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("six") / "capture"
    capture = Capture(folder, "six", 60.0, FRAMES, CLOTH, {"hem": PAINT, "neck": PAINT})
    for frame_id in FRAMES:
        mesh = tube(60, 56, 0.15, 0.6)
        painted = (mesh.vertices[:, 1] < 0.02) | (mesh.vertices[:, 1] > 0.58)
        bent = mesh.vertices + [[0.003 * frame_id, 0, 0]] * (mesh.vertices[:, 1:2] / 0.6) ** 2
        colours = np.where(painted[:, None], PAINT, CLOTH).astype(np.uint8)
        scan = Scan(Mesh(bent.astype(np.float32), mesh.faces), colours, frame_id, 0.0)
        write_scan(folder / "scans" / f"{frame_id:06d}.ply", scan)
    template = replace(tube(24, 14, 0.15, 0.6), uv=None)
    hem, neck = sorted(boundary_loops(template.faces), key=lambda loop: template.vertices[loop, 1].mean())
    save_garment(folder / "template.npz", Garment(template, {"hem": hem, "neck": neck}))
    write_capture_description(capture)
    return folder


def head(vertices: int, faces: int, form: str = "ascii") -> str:
    colours = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    places = "".join(f"property float {name}\n" for name in "xyz")
    return (
        f"ply\nformat {form} 1.0\nelement vertex {vertices}\n{places}{colours}element face {faces}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )


def replaced(data: bytes | str, suffix: str = ".ply", **beside: bytes | str) -> Callable[[Path], None]:
    """The frame's file is another, with files beside it."""

    def damage(scan: Path) -> None:
        scan.unlink()
        scan.with_suffix(suffix).write_bytes(data.encode() if isinstance(data, str) else data)
        for name, content in beside.items():
            path = scan.parent / name.replace("__", ".")
            path.write_bytes(content.encode() if isinstance(content, str) else content)

    return damage


def cut(scan: Path) -> None:
    scan.write_bytes(scan.read_bytes()[:2000])


def somewhere_nan(scan: Path) -> None:
    data = bytearray(scan.read_bytes())
    start = data.index(b"end_header\n") + len(b"end_header\n")
    data[start : start + 4] = np.float32(np.nan).tobytes()
    scan.write_bytes(bytes(data))


def binary_empty(scan: Path) -> None:
    write_mesh(scan, Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)), colours=np.zeros((0, 3), np.uint8))


def in_one_place(scan: Path) -> None:
    found = read_coloured_mesh(scan)
    write_mesh(scan, Mesh(0 * found.mesh.vertices, found.mesh.faces), colours=found.colours)


def far_away(scan: Path) -> None:
    found = read_coloured_mesh(scan)
    write_mesh(scan, Mesh(found.mesh.vertices * np.float32(1e30), found.mesh.faces), colours=found.colours)


def no_colours(scan: Path) -> None:
    write_mesh(scan, read_coloured_mesh(scan).mesh)


def as_glb(change: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    def damage(scan: Path) -> None:
        found = read_coloured_mesh(scan)
        scan.unlink()
        write_mesh(scan.with_suffix(".glb"), found.mesh, colours=found.colours)
        scan.with_suffix(".glb").write_bytes(change(scan.with_suffix(".glb").read_bytes()))

    return damage


OBJ = "mtllib skin.mtl\nusemtl skin\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"
MATERIAL = "newmtl skin\nmap_Kd skin.png\n"
FLAT = "".join(f"{x} {y} 0 1 2 3\n" for x in range(20) for y in range(20))
DAMAGE = {
    "no bytes": (replaced(b""), "frame-empty"),
    "an empty text ply": (replaced(head(0, 0)), "frame-empty"),
    "an empty binary ply": (binary_empty, "frame-empty"),
    "a ply that is cut off": (cut, "frame-unreadable"),
    "a ply that says more than it has": (replaced(head(400_000_000, 1)), "frame-unreadable"),
    "a ply of NaN": (somewhere_nan, "frame-nan"),
    "another's bytes": (replaced(bytes(range(256)) * 20), "frame-unreadable"),
    "faces of other vertices": (replaced(head(3, 1) + "0 0 0 1 2 3\n" * 3 + "3 0 1 77\n"), "frame-unreadable"),
    "all in one place": (in_one_place, "frame-empty"),
    "far away": (far_away, "frame-unreadable"),
    "a few points": (replaced(head(20, 0) + "".join(f"{x} 0 {x % 3} 1 2 3\n" for x in range(20))), "frame-unreadable"),
    "points in a plane": (replaced(head(400, 0) + FLAT), ""),
    "one triangle": (replaced(head(3, 1) + "0 0 0 1 2 3\n1 0 0 1 2 3\n0 1 0 1 2 3\n3 0 1 2\n"), ""),
    "no colours": (no_colours, "colours-missing"),
    "an empty obj": (replaced("# nothing\n", ".obj"), "frame-empty"),
    "an obj of garbage": (replaced("v 0 0 0\nv one two three\nf 1 2 3\n", ".obj"), "frame-unreadable"),
    "an obj of other vertices": (replaced("v 0 0 0\nf 1 2 3\n", ".obj"), "frame-unreadable"),
    "no materials": (replaced(OBJ, ".obj"), "frame-unreadable"),
    "no texture": (replaced(OBJ, ".obj", skin__mtl=MATERIAL), "frame-unreadable"),
    "a damaged texture": (
        replaced(OBJ, ".obj", skin__mtl=MATERIAL, skin__png=b"\x89PNG\r\n\x1a\n"),
        "frame-unreadable",
    ),
    "a texture elsewhere": (replaced(OBJ, ".obj", skin__mtl="newmtl skin\nmap_Kd ../x.png\n"), "frame-unreadable"),
    "a glb that is cut off": (as_glb(lambda data: data[:900]), "frame-unreadable"),
    "a glb of nothing": (as_glb(lambda data: data[:12]), "frame-unreadable"),
    "a glb of noise": (as_glb(lambda data: data[:20] + b"?" * (len(data) - 20)), "frame-unreadable"),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_a_damaged_frame_is_flagged_and_the_take_goes_on(kind: str, sound: Path, tmp_path: Path):
    folder = tmp_path / "capture"
    shutil.copytree(sound, folder)
    damage, code = DAMAGE[kind]
    damage(folder / "scans" / f"{BAD:06d}.ply")
    extracted = pipeline.extract(folder, tmp_path / "work")
    assert set(extracted.failed) == {BAD}
    assert f"{BAD:06d}" in extracted.failed[BAD] or "skin.png: " in extracted.failed[BAD], "the reason names the file"
    registered = pipeline.register(folder, tmp_path / "work", QUICK)
    assert dict(registered.failed) == dict(extracted.failed)
    assert open_work(tmp_path / "work").registered.frame_ids.tolist() == list(FRAMES)
    findings = [finding for finding in pipeline.check(folder).verdict.findings if BAD in finding.frames]
    if code:
        assert code in [finding.code for finding in findings]


@pytest.mark.parametrize("fault", [OSError(errno.EIO, "Input/output error"), PermissionError(13, "Permission denied"),
                                   MemoryError(), RuntimeError("whatever")])  # fmt: skip
def test_whatever_reading_one_frame_raises_is_that_frames(
    fault: Exception, sound: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    from capture4d.mesh_files import meshes

    plain = meshes.read_ply

    def read(path: Path, *arguments, **options):
        if path.stem.endswith(str(BAD)):
            raise fault
        return plain(path, *arguments, **options)

    monkeypatch.setattr(meshes, "read_ply", read)
    extracted = pipeline.extract(sound, tmp_path / "work")
    assert set(extracted.failed) == {BAD}
    checked = pipeline.check(sound)
    assert [finding.code for finding in checked.verdict.findings if finding.frames == (BAD,)][:1] == [
        "frame-unreadable"
    ]


def test_a_fault_of_our_own_keeps_its_traceback(sound: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def broken(*_):
        raise ZeroDivisionError

    monkeypatch.setattr(scan_files, "weld", broken)
    with pytest.raises(ZeroDivisionError):
        pipeline.extract(sound, tmp_path / "work")


def test_the_first_frame_may_be_the_bad_one(sound: Path, tmp_path: Path):
    """A scan that can be read, but shows none of the garment."""
    folder = tmp_path / "capture"
    shutil.copytree(sound, folder)
    replaced(head(3, 1) + "0 0 0 1 2 3\n1 0 0 1 2 3\n0 1 0 1 2 3\n3 0 1 2\n")(folder / "scans" / "000001.ply")
    assert set(pipeline.extract(folder, tmp_path / "work").failed) == {1}
    for frame_id in FRAMES[1:]:
        shutil.copy(folder / "scans" / "000001.ply", folder / "scans" / f"{frame_id:06d}.ply")
    with pytest.raises(InputError, match=r"000001\.ply: garment colour #2f62c9 not found"):
        pipeline.extract(folder, tmp_path / "other")


@pytest.mark.slow
def test_a_run_says_so_and_its_code_follows_the_limit(sound: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = tmp_path / "capture"
    shutil.copytree(sound, folder)
    replaced(head(0, 0))(folder / "scans" / f"{BAD:06d}.ply")
    command = ["run", str(folder), "--output", str(tmp_path / "work"), "--workers", "1"]
    with pytest.raises(SystemExit) as first:
        main(command)
    with pytest.raises(SystemExit) as second:
        main([*command, "--max-failed", "20"])
    assert (first.value.code, second.value.code or 0) == (3, 0)
    metrics = [
        json.loads(line) for line in (tmp_path / "work" / "registration" / "metrics.jsonl").read_text().splitlines()
    ]
    assert [record["frame_id"] for record in metrics if record["verdict"] == "failed"] == [BAD]
    assert "empty mesh" in (tmp_path / "work" / "report" / "index.html").read_text()


def test_textures_and_seams_of_sound_frames_are_read(sound: Path, tmp_path: Path):
    """A textured obj whose faces share no vertex is the same tube to every stage."""
    folder = tmp_path / "capture"
    shutil.copytree(sound, folder)
    place = folder / "scans" / f"{BAD:06d}.ply"
    found = read_coloured_mesh(place)
    place.unlink()
    corners = found.mesh.faces.reshape(-1)
    v = found.mesh.vertices[corners]
    height = v[:, 1] / 0.6
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in v] + [f"vt 0.5 {t:.6f}" for t in height]
    lines += [f"f {i}/{i} {i + 1}/{i + 1} {i + 2}/{i + 2}" for i in range(1, len(v), 3)]
    place.with_suffix(".OBJ").write_text("mtllib skin.mtl\n" + "\n".join(lines))
    (folder / "scans" / "skin.mtl").write_text(MATERIAL)
    rows = np.linspace(1, 0, 600)[:, None]
    picture = np.where((rows < 0.02 / 0.6) | (rows > 0.58 / 0.6), [PAINT], [CLOTH]).astype(np.uint8)
    Image.fromarray(picture[:, None].repeat(4, axis=1)).save(folder / "scans" / "skin.png")
    scan = read_scan(read_capture(folder), BAD)
    assert len(scan.mesh.vertices) == len(found.mesh.vertices)
    assert len(boundary_loops(scan.mesh.faces)) == 2
    assert pipeline.extract(folder, tmp_path / "work").failed == {}


def test_clouds_among_meshes_are_told_and_registered(sound: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = tmp_path / "capture"
    shutil.copytree(sound, folder)
    for frame_id in (BAD, 5):
        path = folder / "scans" / f"{frame_id:06d}.ply"
        found = read_coloured_mesh(path)
        write_mesh(path, Mesh(found.mesh.vertices, found.mesh.faces[:0]), colours=found.colours)
    with pytest.raises(SystemExit):
        main(["extract", str(folder), "--output", str(tmp_path / "work"), "--workers", "1"])
    assert "2 scans are points without faces; normals and faces are estimated" in capsys.readouterr().err
    assert json.loads((tmp_path / "work" / "garment" / "clouds.json").read_text()) == {"frames": [BAD, 5]}
    assert pipeline.register(folder, tmp_path / "work", QUICK).failed == {}
    records = {record["frame_id"]: record for record in open_work(tmp_path / "work").records}
    meshed = np.mean([records[frame_id]["fit_mean_mm"] for frame_id in (2, 4)])
    assert records[BAD]["fit_mean_mm"] < 1.15 * meshed + 0.05
    (finding,) = [each for each in pipeline.check(folder).verdict.findings if each.code == "faces-missing"]
    assert (finding.frames, finding.severity) == ((BAD, 5), "warning")
