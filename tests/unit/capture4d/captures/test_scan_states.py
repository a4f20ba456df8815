"""A scan's digest is that of what was read of it, and it is read again only when its size or time have changed."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from capture4d.captures.capture import Capture, read_scan
from capture4d.captures.scan_states import as_it_is_now, replaced_scan, scan_digest, scan_looked_at, stands_with_scan
from capture4d.errors import InputError
from capture4d.mesh_files.meshes import write_mesh
from capture4d.runs import made as made_module
from capture4d.runs.made import FileState, Ledger, make
from capture4d.types import Mesh

OBJ = "mtllib skin.mtl\nusemtl skin\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"


@pytest.fixture
def textured(tmp_path: Path) -> Capture:
    """Frame 1 names a texture by way of a material; frame 2 is a ply of its own."""
    scans = tmp_path / "capture" / "scans"
    (scans / "textures").mkdir(parents=True)
    (scans / "1.obj").write_text(OBJ)
    (scans / "skin.mtl").write_text("newmtl skin\nmap_Kd textures/skin.png\n")
    Image.fromarray(np.full((4, 4, 3), 90, np.uint8)).save(scans / "textures" / "skin.png")
    capture = Capture(tmp_path / "capture", "take", 60.0, (1, 2), (47, 98, 201))
    corner = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    write_mesh(scans / "2.ply", Mesh(corner, np.array([[0, 1, 2]], np.int32)), colours=np.zeros((3, 3), np.uint8))
    for path in scans.rglob("*.*"):
        age(path)
    return capture


def age(path: Path, seconds: int = 100) -> None:
    """Make a file so old that its time is believed."""
    found = path.stat()
    os.utime(path, ns=(found.st_atime_ns, found.st_mtime_ns - seconds * 10**9))


def look(capture: Capture, frame_id: int) -> tuple[FileState, ...]:
    with scan_looked_at(capture, frame_id) as looked:
        read_scan(capture, frame_id)
    return tuple(looked)


def test_what_a_scan_names_belongs_to_it_and_to_no_other(textured: Capture):
    first, second = look(textured, 1), look(textured, 2)
    assert [each.name for each in first] == ["1.obj", "skin.mtl", "textures/skin.png"]
    assert [each.name for each in second] == ["2.ply"]
    picture = textured.path / "scans" / "textures" / "skin.png"
    Image.fromarray(np.full((4, 4, 3), 91, np.uint8)).save(picture)
    assert scan_digest(as_it_is_now(textured, 1, first)) != scan_digest(first)
    assert as_it_is_now(textured, 2, second) is second
    picture.unlink()
    gone = as_it_is_now(textured, 1, first)
    assert [each.digest for each in gone][2] == "absent"


def test_a_texture_that_is_missing_is_missed(textured: Capture):
    picture = textured.path / "scans" / "textures" / "skin.png"
    data = picture.read_bytes()
    picture.unlink()
    with scan_looked_at(textured, 1) as looked, pytest.raises(InputError, match=r"skin\.png"):
        read_scan(textured, 1)
    assert [(each.name, each.digest == "absent") for each in looked][-1] == ("textures/skin.png", True)
    picture.write_bytes(data)
    assert scan_digest(as_it_is_now(textured, 1, tuple(looked))) != scan_digest(looked)


def test_names_do_not_count_but_the_kind_of_file_does(textured: Capture):
    scans = textured.path / "scans"
    before = look(textured, 2)
    (scans / "2.ply").rename(scans / "take_2.ply")
    assert scan_digest(as_it_is_now(textured, 2, before)) == scan_digest(before)
    assert scan_digest([replace(before[0], name="2.off")]) != scan_digest(before)


def test_a_scan_is_hashed_again_only_if_size_or_time_differ(textured: Capture, monkeypatch: pytest.MonkeyPatch):
    before = look(textured, 2)
    read: list[Path] = []
    plain = made_module._hashed
    monkeypatch.setattr(made_module, "_hashed", lambda path: read.append(path) or plain(path))
    assert as_it_is_now(textured, 2, before) is before
    assert not read
    age(textured.path / "scans" / "2.ply", 50)
    again = as_it_is_now(textured, 2, before)
    assert (len(read), scan_digest(again)) == (1, scan_digest(before))
    assert as_it_is_now(textured, 2, again) == again
    assert len(read) == 1, "its new time is known"


def test_a_file_too_fresh_is_hashed_until_its_time_can_be_believed(textured: Capture):
    """Written twice within what a file system counts as one moment, at the same size."""
    path = textured.path / "scans" / "2.ply"
    path.touch()
    before = look(textured, 2)
    assert before[0].time_ns == 0
    moment = path.stat().st_mtime_ns
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(bytes(data))
    os.utime(path, ns=(moment, moment))
    assert scan_digest(as_it_is_now(textured, 2, before)) != scan_digest(before)


def test_a_file_stands_with_its_scan_and_what_else_it_was_made_from(textured: Capture, tmp_path: Path):
    folder = tmp_path / "stage"
    path = folder / "frames" / "000002.npz"
    path.parent.mkdir(parents=True)
    looked = look(textured, 2)
    make(folder, path, lambda: path.write_bytes(b"x"), inputs={"scan": scan_digest(looked), "a": "1"}, files=looked)
    ledger = Ledger.open(folder)
    assert stands_with_scan(ledger, path, textured, 2, {"a": "1"})
    assert not stands_with_scan(ledger, path, textured, 2, {"a": "2"})
    assert not stands_with_scan(ledger, path, textured, 2, {})
    assert not stands_with_scan(ledger, folder / "frames" / "000001.npz", textured, 1, {"a": "1"})
    age(textured.path / "scans" / "2.ply", 7)
    assert stands_with_scan(ledger, path, textured, 2, {"a": "1"}), "copied, perhaps"
    assert not replaced_scan(ledger, path, textured, 2)
    (textured.path / "scans" / "2.ply").write_bytes(b"another")
    assert not stands_with_scan(ledger, path, textured, 2, {"a": "1"})
    assert replaced_scan(ledger, path, textured, 2)


def test_a_file_whose_scan_was_damaged_never_stands(textured: Capture, tmp_path: Path):
    folder = tmp_path / "stage"
    path = folder / "000002.npz"
    folder.mkdir()
    looked = look(textured, 2)
    make(
        folder, path, lambda: path.write_bytes(b"x"), inputs={"scan": scan_digest(looked)}, files=looked,
        said={"damaged": True},
    )  # fmt: skip
    assert not stands_with_scan(Ledger.open(folder), path, textured, 2, {})
