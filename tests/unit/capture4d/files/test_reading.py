"""What a file names is read where it may lie, and nowhere else; what is no file is not opened."""

import os
import socket
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from capture4d.cli.main import main
from capture4d.errors import InputError
from capture4d.files.atomic import read_json
from capture4d.files.records import load_poses, load_rig
from capture4d.mesh_files.meshes import read_coloured_mesh

MESH = "mtllib x.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl skin\nf 1/1 2/2 3/3\n"


def scan_with(texture: str, folder: Path) -> Path:
    """A textured obj in CAPTURE/scans; textures called t.png lie beside it, in CAPTURE, and outside."""
    scans = folder / "capture" / "scans"
    for place in (scans, scans.parent, folder):
        place.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.full((2, 2, 3), 90, np.uint8)).save(place / "t.png")
    (scans / "x.obj").write_text(MESH)
    (scans / "x.mtl").write_text(f"newmtl skin\nmap_Kd {texture}\n")
    return scans / "x.obj"


def colours(path: Path) -> list[int]:
    found = read_coloured_mesh(path).colours
    assert found is not None
    return found[:, 0].tolist()


def test_a_capture_is_one_place_to_what_lies_in_it(tmp_path: Path) -> None:
    path = scan_with("../t.png", tmp_path)
    with pytest.raises(InputError, match=r"x\.obj: expected the texture beside it or in a folder below, found"):
        colours(path)
    (tmp_path / "capture" / "capture.json").write_text("{}")
    assert colours(path) == [90] * 3
    assert colours(scan_with("../scans/t.png", tmp_path)) == [90] * 3


@pytest.mark.parametrize("name", ["C:\\t.png", "/{outside}/t.png"])
def test_of_an_absolute_path_the_name_counts(name: str, tmp_path: Path) -> None:
    path = scan_with(name.replace("/{outside}", str(tmp_path)), tmp_path)
    Image.fromarray(np.full((2, 2, 3), 10, np.uint8)).save(path.with_name("t.png"))
    assert colours(path) == [10] * 3


@pytest.mark.parametrize("name", ["../../t.png", "../scans/../../t.png", "C:\\t.png", "/{outside}/t.png"])
def test_outside_of_it_nothing_is_read(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = name.replace("/{outside}", str(tmp_path))
    path = scan_with(name, tmp_path)
    path.with_name("t.png").unlink()
    (tmp_path / "capture" / "capture.json").write_text("{}")
    with pytest.raises(InputError, match=r"expected the texture .* --allow-outside reads it all the same"):
        colours(path)
    monkeypatch.setenv("CAPTURE4D_ALLOW_OUTSIDE", "1")
    if name.startswith("C:"):
        with pytest.raises(InputError, match="no such file"):
            colours(path)
    else:
        assert colours(path) == [90] * 3


@pytest.mark.parametrize("link", ["file", "folder", "circle"])
def test_links_are_followed_before_that_is_judged(link: str, tmp_path: Path) -> None:
    path = scan_with("in/t.png" if link == "folder" else "in.png", tmp_path)
    if link == "folder":
        (path.parent / "in").symlink_to(tmp_path, target_is_directory=True)
    else:
        (path.parent / "in.png").symlink_to(tmp_path / "t.png" if link == "file" else "in.png")
    with pytest.raises(InputError, match=r"expected the texture beside it or in a folder below|no such file"):
        colours(path)


def test_a_folder_of_scans_may_itself_be_a_link(tmp_path: Path) -> None:
    path = scan_with("t.png", tmp_path / "disk")
    (tmp_path / "take").mkdir()
    (tmp_path / "take" / "scans").symlink_to(path.parent, target_is_directory=True)
    assert colours(tmp_path / "take" / "scans" / "x.obj") == [90] * 3


def pipe(path: Path) -> None:
    os.mkfifo(path)


def unix_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as listening:
        os.chdir(path.parent)  # names of sockets are short
        listening.bind(path.name)


def device(path: Path) -> None:
    path.symlink_to("/dev/zero")


@pytest.mark.parametrize(("make", "said"), [(pipe, "a pipe"), (unix_socket, "a socket"), (device, "a device")])
@pytest.mark.parametrize(
    ("name", "read"),
    [("x.ply", read_coloured_mesh), ("x.obj", read_coloured_mesh), ("x.glb", read_coloured_mesh),
     ("x.json", read_json), ("rig.json", load_rig), ("x.npz", load_poses)],
)  # fmt: skip
def test_what_is_no_file_is_not_opened(
    name: str, read: Callable[[Path], object], make: Callable[[Path], None], said: str, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    make(tmp_path / name)
    with pytest.raises(InputError, match=f"found {said}"):
        read(tmp_path / name)


@pytest.mark.parametrize("make", [pipe, device])
def test_a_texture_that_is_no_file_is_not_opened(make: Callable[[Path], None], tmp_path: Path) -> None:
    path = scan_with("p.png", tmp_path)
    make(path.parent / "p.png")
    with pytest.raises(InputError, match=r"found a pipe|outside|beside it"):
        colours(path)


def test_the_command_lets_a_name_lead_outside(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = scan_with("../../t.png", tmp_path)
    path.rename(path.with_name("000001.obj"))
    for options in ((), ("--allow-outside",)):
        with pytest.raises(SystemExit):
            main(["check", str(path.parent), "--workers", "1", "--fps", "60", "--json", *options])
        said = capsys.readouterr()
        assert ("--allow-outside" in said.out + said.err) == (not options)
    assert "CAPTURE4D_ALLOW_OUTSIDE" not in os.environ
