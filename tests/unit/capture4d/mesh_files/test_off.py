"""OFF files of any of its dialects, against what they were made of and against trimesh."""

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh

from capture4d.errors import EmptyMeshError, InputError
from capture4d.mesh_files.meshes import read_mesh, write_mesh
from capture4d.mesh_files.polygons import MeshFile
from capture4d.types import Mesh

POINTS = ["0 0 0", "1 0 0.25", "1 1 0", "0 1 0.5", "2 0 0"]
BYTES = [[0, 7, 255], [200, 100, 50], [1, 2, 3], [127, 128, 129], [255, 255, 0]]
TRIANGLES = [[0, 1, 2], [0, 2, 3], [1, 4, 2]]
WHOLE = [" ".join(map(str, row)) for row in BYTES]
UNIT = [" ".join(f"{byte / 255:.6f}" for byte in row) for row in BYTES]
UV = [" ".join(point.split()[:2]) for point in POINTS]
FACES = ["4 0 1 2 3", "3 1 4 2"]


def off(head: str = "OFF", *behind: list[str], counts: str = "\n5 2 6\n", faces: list[str] = FACES) -> str:
    lines = [" ".join(words) for words in zip(POINTS, *behind, strict=True)]
    return f"{head}{counts}" + "\n".join([*lines, *faces]) + "\n"


def read(folder: Path, text: str | bytes) -> MeshFile:
    (folder / "x.off").write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_mesh(folder / "x.off")


NORMALS = ["0 0 1"] * 5
SPELLINGS = {
    "as it is": off(),
    "small letters": off("off"),
    "counts behind the word": off(counts=" 5 2 6\n"),
    "counts without a blank": off(counts="5 2 6\n"),
    "no count of edges": off(counts="\n5 2\n"),
    "no word": off("", counts="5 2 0\n"),
    "comments": "# first\n" + off().replace("\n", " # what\n# 1 2 3\n"),
    "a comment behind the word": off("OFF # made by hand"),
    "blank lines": off().replace("\n", "\n\n"),
    "CRLF": off().replace("\n", "\r\n"),
    "CR": off().replace("\n", "\r"),
    "tabs and indents": off().replace(" ", "\t").replace("\n", "\n  "),
    "byte order mark": "\ufeff" + off(),
    "normals": off("NOFF", NORMALS),
    "normals in small letters": off("noff", NORMALS),
    "lines behind": off() + "what is this\n",
    "numbers behind vertices": off("OFF", ["9"] * 5),
    "an index of a colour": off(faces=[f"{face} 7" for face in FACES]),
}


@pytest.mark.parametrize("name", SPELLINGS)
def test_the_same_mesh_however_it_is_spelled(name: str, tmp_path: Path):
    found = read(tmp_path, SPELLINGS[name])
    assert found.mesh.faces.tolist() == TRIANGLES
    assert found.mesh.vertices.tolist() == [[float(word) for word in point.split()] for point in POINTS]
    assert found.polygon_sizes is not None
    assert found.polygon_sizes.tolist() == [4, 3]
    assert (found.colours, found.notes) == (None, ())


@pytest.mark.parametrize("name", ["as it is", "CRLF", "comments", "no count of edges"])
def test_trimesh_agrees(name: str, tmp_path: Path):
    read(tmp_path, SPELLINGS[name].replace("\n5 2\n", "\n5 2 0\n"))
    theirs = trimesh.load(tmp_path / "x.off", process=False)
    assert isinstance(theirs, trimesh.Trimesh)
    np.testing.assert_array_equal(read_mesh(tmp_path / "x.off").mesh.vertices, theirs.vertices)
    assert sorted(map(sorted, theirs.faces.tolist())) == sorted(map(sorted, TRIANGLES))


@pytest.mark.parametrize(
    "text",
    [
        off("COFF", WHOLE), off("COFF", UNIT), off("COFF", WHOLE, ["255"] * 5), off("COFF", UNIT, ["1.0"] * 5),
        off("NCOFF", NORMALS, WHOLE), off("NCOFF", WHOLE, ["255"] * 5, NORMALS),
        off("NCSTOFF", WHOLE, ["255"] * 5, NORMALS, UV), off("CSTOFF", WHOLE, UV),
        off("CNOFF", NORMALS, WHOLE), off("STCOFF", WHOLE, ["255"] * 5, UV), off("STCNOFF", NORMALS, UNIT, UV),
    ],
)  # fmt: skip
def test_colours_of_vertices(text: str, tmp_path: Path):
    found = read(tmp_path, text)
    np.testing.assert_array_equal(found.colours, BYTES)
    assert (found.mesh.uv is not None) == ("ST" in text[: text.index("OFF")])


@pytest.mark.parametrize("text", [off("STOFF", UV), off("STNOFF", NORMALS, UV)])
def test_uvs(text: str, tmp_path: Path):
    expected = np.array([[float(word) for word in uv.split()] for uv in UV])[np.array(TRIANGLES)]
    np.testing.assert_array_equal(read(tmp_path, text).mesh.uv, expected)


@pytest.mark.parametrize("colours", [("10 20 30", "100 110 120"), ("10 20 30 255", "100 110 120 255"),
                                     ("0.039216 0.078431 0.117647 1", "0.392157 0.431373 0.470588 1")])  # fmt: skip
def test_colours_of_faces_are_the_mean_at_a_vertex(colours: tuple[str, str], tmp_path: Path):
    found = read(tmp_path, off(faces=[f"{face} {colour}" for face, colour in zip(FACES, colours, strict=True)])).colours
    assert found is not None
    assert found[[0, 1, 3, 4]].tolist() == [[10, 20, 30], [55, 65, 75], [10, 20, 30], [100, 110, 120]]
    some = read(tmp_path, off(faces=[FACES[0], f"{FACES[1]} {colours[1]}"]))
    assert some.colours is not None
    assert some.colours[[0, 1]].tolist() == [[0, 0, 0], [100, 110, 120]]
    assert some.notes == ("2 of 5 vertices are in no coloured face: black",)
    loose = off(counts="\n6 2 0\n", faces=["9 9 9", *(f"{face} {colours[0]}" for face in FACES)])
    assert read(tmp_path, loose).notes == (), "a vertex in no face at all needs no colour"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "not an OFF file"),
        ("hello\n1 2 3\n", "not an OFF file, expected it to begin with 'OFF', found 'hello'"),
        (off("OFFICE"), "not an OFF file"),
        (off("OFF BINARY"), "expected an OFF file of text, found a binary one"),
        (off("4OFF"), "expected three dimensions, found '4OFF'"),
        (off(counts="\nfive 2 6\n"), "expected counts of vertices and faces, found 'five 2 6'"),
        (off(counts="\n-5 2 6\n"), "expected counts"),
        (off(counts="\n5\n"), "expected counts"),
        (off(counts="\ninf 2 6\n"), "expected counts"),
        (off(counts="\n5 3 6\n"), "cut off, expected lines of 5 vertices and 3 faces, found 7"),
        (off(counts="\n1e15 3 6\n"), "cut off"),
        (off().replace("1 0 0.25", "1 0"), "x.off:4: expected at least 3 numbers, found 2"),
        (off().replace("1 0 0.25", "1 O 0"), "x.off:4: expected numbers, found '1 O 0'"),
        (off().replace("1 0 0.25", "1 nan 0"), "expected finite numbers"),
        (off("COFF"), "x.off:3: expected at least 6 numbers, found 3"),
        (off().replace("3 1 4 2", "3 1 4"), "x.off:9: expected 3 corners, found 2 numbers"),
        (off().replace("3 1 4 2", "-3 1 4 2"), "x.off:9: expected -3 corners"),
        (off().replace("3 1 4 2", "nan 1 4 2"), "x.off:9: expected nan corners"),
        (off().replace("3 1 4 2", "3 1 4 2.5"), "expected whole numbers as corners, found 2.5"),
        (off().replace("3 1 4 2", "3 1 4 5"), "expected vertex indices from 0 to 4, found 0..5"),
        (off().replace("3 1 4 2", "2 1 4"), "expected at least 3 corners, found 2"),
        (off().encode("utf-16"), "expected UTF-8, found UTF-16 text"),
    ],
)
def test_what_is_wrong_is_one_line(text: str | bytes, said: str, tmp_path: Path):
    with pytest.raises(InputError, match=re.escape(said)) as caught:
        read(tmp_path, text)
    assert "\n" not in str(caught.value)


def test_no_face_is_an_empty_mesh(tmp_path: Path):
    with pytest.raises(EmptyMeshError):
        read(tmp_path, "OFF\n0 0 0\n")
    read_cloud = off(counts="\n5 0 0\n", faces=[])
    with pytest.raises(EmptyMeshError, match="found 5 vertices and no faces"):
        read(tmp_path, read_cloud)
    assert len(read_mesh(tmp_path / "x.off", faces_needed=False).mesh.vertices) == 5


def test_what_is_written_comes_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    mesh = Mesh(rng.normal(0, 0.5, (40, 3)).astype(np.float32), rng.integers(0, 40, (60, 3)).astype(np.int32))
    write_mesh(tmp_path / "m.off", mesh)
    found = read_mesh(tmp_path / "m.off").mesh
    np.testing.assert_array_equal(found.faces, mesh.faces)
    np.testing.assert_allclose(found.vertices, mesh.vertices, rtol=0, atol=1e-7)
