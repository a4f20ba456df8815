"""Files that were made to do harm: each is one line of the command, in little memory, and nothing is written."""

import contextlib
import json
import os
import struct
import tracemalloc
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from benchmarks.reader_values import BODY, RIG
from capture4d.cameras.colmap import write_model
from capture4d.cli.main import main
from capture4d.files.records import save_body

Make = Callable[[Path], Path]
CORNERS = b"".join(struct.pack("<3f", *corner) for corner in ((0, 0, 0), (1, 0, 0), (0, 1, 0)))
XYZ = "property float x\nproperty float y\nproperty float z\n"


def ply(head: str, body: bytes, *, form: str = "binary_little_endian") -> Make:
    def make(folder: Path) -> Path:
        (folder / "x.ply").write_bytes(f"ply\nformat {form} 1.0\n{head}end_header\n".encode() + body)
        return folder / "x.ply"

    return make


def triangle(faces: str, body: bytes, vertices: str = XYZ) -> Make:
    return ply(f"element vertex 3\n{vertices}element face 1\n{faces}", CORNERS + body)


def obj(*lines: str) -> Make:
    def make(folder: Path) -> Path:
        (folder / "x.obj").write_text("\n".join(lines))
        return folder / "x.obj"

    return make


def textured(materials: str, texture: bytes = b"") -> Make:
    """A capture of one scan whose texture is somewhere else, or something else."""

    def make(folder: Path) -> Path:
        (folder / "secret.png").write_bytes(b"\x89PNG")
        path = folder / "capture" / "scans" / "000001.obj"
        path.parent.mkdir(parents=True)
        colours = {"garment_colour": "#2f62c9", "boundary_colours": {"hem": "#ff0000"}}
        (folder / "capture" / "capture.json").write_text(json.dumps({"format": 1, "fps": 60, **colours}))
        path.write_text("\n".join(("mtllib x.mtl", *TEXTURED)))
        path.with_name("x.mtl").write_text(f"newmtl a\nmap_Kd {materials}\n")
        path.with_name("t.png").write_bytes(texture)
        return path

    return make


TEXTURED = ("v 0 0 0", "v 1 0 0", "v 0 1 0", "vt 0 0", "vt 1 0", "vt 0 1", "usemtl a", "f 1/1 2/2 3/3")


def scene(**changes: object) -> Make:
    """A glb of one triangle, its JSON changed."""
    tree: dict[str, object] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"byteLength": 36}],
    }

    def make(folder: Path) -> Path:
        text = json.dumps(tree | changes).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", 36, b"BIN\0") + CORNERS
        (folder / "x.glb").write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
        return folder / "x.glb"

    return make


def accessor(**changes: object) -> Make:
    return scene(accessors=[{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"} | changes])


def doubling(depth: int) -> list[dict[str, object]]:
    """Each node names the next one twice."""
    return [{"children": [row + 1, row + 1]} for row in range(depth)] + [{"mesh": 0}]


def archive(descr: str, shape: str) -> Make:
    def make(folder: Path) -> Path:
        header = f"{{'descr': {descr!r}, 'fortran_order': False, 'shape': {shape}}}\n".encode()
        member = b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header
        with zipfile.ZipFile(folder / "x.npz", "w") as file:
            for name in ("rotations", "poses", "trans"):
                file.writestr(f"{name}.npy", member)
        return folder / "x.npz"

    return make


MESHES: dict[str, Make] = {
    "a list as long as its type can say": triangle("property list uint int vertex_indices\n", b"\xff" * 16),
    "a list of negative length": triangle("property list int int vertex_indices\n", struct.pack("<4i", -3, 0, 1, 2)),
    "a list whose length is infinite": triangle(
        "property list float int vertex_indices\n", struct.pack("<f3i", np.inf, 0, 1, 2)
    ),
    "one number for a list": triangle("property int vertex_indices\n", struct.pack("<i", 0)),
    "indices that wrap": triangle("property list uchar uint vertex_indices\n", struct.pack("<B3I", 3, 0, 1, 2**32 - 1)),
    "indices that do not exist": triangle("property list uchar int vertex_indices\n", struct.pack("<B3i", 3, 0, 1, 9)),
    "elements without properties": ply(f"element vertex 3\n{XYZ}element face 1000000000000\n", CORNERS),
    "vertices twice": ply(f"element vertex 3\n{XYZ}element vertex 3\n{XYZ}", CORNERS * 2),
    "more than there is": ply(f"element vertex 1000000000000\n{XYZ}", CORNERS),
    "text that ends early": ply(f"element vertex 1000000000000\n{XYZ}", b"0 0 0\n", form="ascii"),
    "an index of ten digits": obj("v 0 0 0", "v 1 0 0", "v 0 1 0", "f 1 2 9999999999"),
    "an accessor beyond its bytes": accessor(count=10**12),
    "an accessor without bytes": scene(accessors=[{"componentType": 5126, "count": 10**12, "type": "VEC3"}]),
    "a buffer elsewhere": scene(buffers=[{"uri": "../secret.png", "byteLength": 36}]),
    "a scene in a circle": scene(nodes=[{"mesh": 0, "children": [1]}, {"children": [0]}]),
    "a scene that doubles": scene(nodes=doubling(60)),
    "nested JSON": scene(extras=json.loads("[" * 500 + "]" * 500), nodes=None),
}
SCANS: dict[str, Make] = {
    "a texture elsewhere": textured("../../secret.png"),
    "a texture on another disk": textured("/etc/hostname"),
    "a texture that starts a program": textured("t.png", b"%!PS-Adobe-3.0 EPSF-3.0\n"),
}
MOTIONS: dict[str, Make] = {
    "a shape of floats": archive("<f4", "(2.0, 3)"),
    "a negative shape": archive("<f4", "(-1, 3)"),
    "a shape of terabytes": archive("<f4", "(1000000000000, 24, 3, 3)"),
    "no width": archive("<U0", "(1000000000000,)"),
    "objects": archive("|O", "(1,)"),
}


@contextlib.contextmanager
def little_memory() -> Iterator[None]:
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < 200_000_000
    finally:
        tracemalloc.stop()


def one_line(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """What a command says of a file, and nothing else."""
    with little_memory(), pytest.raises(SystemExit) as ended:
        main(list(map(str, arguments)))
    said = capsys.readouterr()
    assert (ended.value.code, said.out, said.err.count("\n")) == (1, "", 1), said
    return said.err


def everything(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", [*MESHES, *SCANS, *MOTIONS])
def test_a_hostile_file_is_one_line(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "files").mkdir()
    path = (MESHES | SCANS | MOTIONS)[name](tmp_path / "files")
    before = everything(tmp_path)
    if name in MOTIONS:
        save_body(tmp_path / "body.npz", BODY)
        before = everything(tmp_path)
        said = one_line(capsys, "convert-poses", path, tmp_path / "out.npz", "--body", tmp_path / "body.npz")
    elif name in SCANS:
        output = ("--output", tmp_path / "work", "--workers", "1", "--quiet")
        said = one_line(capsys, "extract", path.parents[1], *output)
    else:
        said = one_line(capsys, "register-mesh", path, path, "--output", tmp_path / "out.ply")
    assert str(path.parent) in said
    assert {
        path: data for path, data in everything(tmp_path).items() if tmp_path / "work" not in path.parents
    } == before


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "frames.bin"])
@pytest.mark.parametrize("count", [2**63, 10**12])
def test_a_colmap_model_that_counts_on_is_one_line(
    name: str, count: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = tmp_path / "model"
    write_model(model, RIG)
    data = (model / name).read_bytes()
    (model / name).write_bytes(struct.pack("<Q", count) + data[8:])
    assert str(model) in one_line(capsys, "convert-rig", model, "--output", tmp_path / "rig.json")
    assert not (tmp_path / "rig.json").exists()


def test_a_pipe_under_the_name_of_a_scan_is_one_line(
    tube_capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scan = next(iter(sorted((tube_capture / "scans").iterdir())))
    scan.unlink()
    os.mkfifo(scan)
    said = one_line(capsys, "extract", tube_capture, "--output", tmp_path / "work", "--workers", "1", "--quiet")
    assert said == f"capture4d: {scan}: no such scan; 1 of 3 frames in capture.json have none\n"
    assert not (tmp_path / "work").exists()
