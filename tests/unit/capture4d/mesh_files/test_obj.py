"""OBJ files as exporters write them: the same mesh, however it is spelled, and as trimesh reads it."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from capture4d.errors import InputError, NotFiniteError
from capture4d.mesh_files.meshes import read_mesh
from capture4d.mesh_files.polygons import MeshFile

RNG = np.random.default_rng(5)
POINTS = RNG.random((12, 3)).round(4)
BYTES = RNG.integers(0, 256, (12, 3))
BYTES[0] = 0, 7, 255
TEXTURE = RNG.random((7, 2)).round(3)
FACES = np.array([RNG.permutation(12)[:3] for _ in range(9)])
WEDGES = RNG.integers(0, 7, (9, 3))


def rows(keyword: str, table: np.ndarray) -> list[str]:
    return [f"{keyword} {' '.join(f'{value:.9g}' for value in row)}" for row in table.tolist()]


V, VT = rows("v", POINTS), rows("vt", TEXTURE)
F = [
    "f " + " ".join(f"{v + 1}/{t + 1}" for v, t in zip(*each, strict=True))
    for each in zip(FACES.tolist(), WEDGES.tolist(), strict=True)
]
LINES = [*V, *VT, *F]
PLAIN = "\n".join(LINES) + "\n"
NORMALS = ["vn 0 0 1"] * 12


def with_normals(line: str) -> str:
    return re.sub(r"(\d+)/(\d+)", r"\1/\2/\1", line)


def backwards(line: str) -> str:
    return re.sub(r"(\d+)/(\d+)", lambda found: f"{int(found[1]) - 13}/{int(found[2]) - 8}", line)


def each(change: Callable[[str], str], keywords: str = "v vt f") -> str:
    chosen = keywords.split()
    return "\n".join(change(line) if line.split()[0] in chosen else line for line in LINES) + "\n"


SPELLINGS: dict[str, str | bytes] = {
    "as it is": PLAIN,
    "without the last line end": PLAIN.rstrip(),
    "byte order mark": "\ufeff" + PLAIN,
    "CRLF": PLAIN.replace("\n", "\r\n"),
    "CR": PLAIN.replace("\n", "\r"),
    "mixed line ends": PLAIN.replace("\n", "\r\n", 5).replace("\n", "\r", 9),
    "tabs": PLAIN.replace(" ", "\t"),
    "two blanks": PLAIN.replace(" ", "  "),
    "indents": PLAIN.replace("\n", "\n   "),
    "indented by tabs": each(lambda line: f"\t{line}", "f"),
    "blanks behind": each(lambda line: f"{line} \t "),
    "form feeds": PLAIN.replace("\nf", "\f\nf"),
    "vertical tabs": PLAIN.replace(" ", "\v"),
    "comments behind": each(lambda line: f"{line} # a comment"),
    "comments behind faces": each(lambda line: f"{line}\t# v 1 2 3", "f"),
    "comments without a blank": each(lambda line: f"{line}# tri", "f"),
    "comments between": PLAIN.replace("\n", "\n# v 1 2 3\n"),
    "a comment that ends in a backslash": PLAIN.replace("\n", "\n# C:\\out\\\n"),
    "a comment behind that ends in a backslash": each(lambda line: f"{line} # C:\\out\\"),
    "blank lines": PLAIN.replace("\n", "\n\n \n"),
    "faces go on": each(lambda line: line.replace(" ", " \\\n"), "f"),
    "faces go on, indented": each(lambda line: line.replace(" ", " \\\n    "), "f"),
    "faces go on without a blank": each(lambda line: line.replace(" ", "\\\n"), "f"),
    "vertices go on": each(lambda line: line.replace(" ", " \\\n", 2), "v vt"),
    "blanks behind the backslash": each(lambda line: line.replace(" ", " \\ \t\n"), "f"),
    "faces go on, CRLF": each(lambda line: line.replace(" ", " \\\n"), "f").replace("\n", "\r\n"),
    "faces go on, comments": each(lambda line: line.replace(" ", " \\\n") + " # end", "f"),
    "a comment among lines that go on": each(lambda line: line + " \\\n# two \\", "f"),
    "capitals": each(lambda line: line.split()[0].upper() + line[len(line.split()[0]) :]),
    "backwards": each(backwards, "f"),
    "normals": "\n".join([*V, *VT, *NORMALS, *map(with_normals, F)]),
    "normals between vertices": "\n".join([*(f"vn 0 0 1\n{line}" for line in V), *VT, *map(with_normals, F)]),
    "faces first": "\n".join([*F, *VT, *V]),
    "faces between": "\n".join([*V[:6], *F[:4], *VT, *F[4:], *V[6:]]),
    "points, lines, curves": PLAIN + "p 1 2\nl 1 2 3\nl 1/1 2/2\nvp 0.5\ncstype bezier\n",
    "groups": PLAIN.replace("\nf", "\ng a b\no c\ns off\nf", 3),
    "a group that ends in a backslash": PLAIN.replace("\nf", "\ng C:\\a\\\nf"),
    "a material with a sign": PLAIN.replace("\nf", "\nusemtl mat#1\nf"),
    "a name in latin-1": ("o Größe\n" + PLAIN).encode("latin-1"),
    "exponents": each(
        lambda line: " ".join(word if word == "v" else f"{float(word):.5e}" for word in line.split()), "v"
    ),
    "signs": each(lambda line: line.replace(" ", " +"), "v vt"),
    "a weight": each(lambda line: f"{line} 1.0", "v"),
    "a third texture coordinate": each(lambda line: f"{line} 0.0", "vt"),
    "subdivision and smoothing": "# by hand\nmg 0\n" + PLAIN.replace("\nf", "\ns 1\nf") + "\nend\n",
    "ZBrush's colours": PLAIN + "#MRGB ffff0000ff00ff00\n",
    "MSVC's numbers in what is not used": PLAIN + "vt -1.#IND 1.#QNAN\n",
}


def read(folder: Path, text: str | bytes) -> MeshFile:
    path = folder / "x.obj"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_mesh(path)


@pytest.mark.parametrize("name", SPELLINGS)
def test_the_same_mesh_however_it_is_spelled(name: str, tmp_path: Path):
    found = read(tmp_path, SPELLINGS[name])
    np.testing.assert_array_equal(found.mesh.vertices, POINTS.astype(np.float32))
    np.testing.assert_array_equal(found.mesh.faces, FACES)
    assert found.mesh.uv is not None
    np.testing.assert_array_equal(found.mesh.uv, TEXTURE.astype(np.float32)[WEDGES])
    assert (found.colours, found.polygon_sizes, found.notes) == (None, None, ())


@pytest.mark.filterwarnings("ignore:All-NaN slice")  # of trimesh, about a material that is not there
@pytest.mark.parametrize("name", ["as it is", "CRLF", "normals", "faces between", "a weight", "groups"])
def test_trimesh_agrees(name: str, tmp_path: Path):
    found = read(tmp_path, SPELLINGS[name])
    theirs = trimesh.load(tmp_path / "x.obj", process=False, split_objects=False, group_material=False)
    assert isinstance(theirs, trimesh.Trimesh)
    assert found.mesh.uv is not None
    np.testing.assert_allclose(found.mesh.vertices[found.mesh.faces], theirs.triangles, atol=1e-6)
    np.testing.assert_allclose(found.mesh.uv, theirs.visual.uv[theirs.faces], atol=1e-6)


def coloured(table: np.ndarray, *, behind: str = "") -> str:
    lines = [
        f"{line} {' '.join(f'{value:.9g}' for value in row)}{behind}"
        for line, row in zip(V, table.tolist(), strict=True)
    ]
    return "\n".join([*lines, *VT, *F])


UNIT = BYTES / 255
ABOVE = UNIT.copy()
ABOVE[3, 1], BEYOND = 1.0003, BYTES.copy()
BEYOND[3, 1] = 255
FEW = "\n".join([*V[:4], *(f"{line} 1 0.5 0" for line in V[4:]), *VT, *F])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (coloured(UNIT), BYTES),
        (coloured(BYTES), BYTES),
        (coloured(BYTES + 0.2), BYTES),
        (coloured(ABOVE), np.rint(np.clip(ABOVE, 0, 1) * 255)),
        (coloured(UNIT - 1e-4), BYTES),
        (coloured(UNIT * 1.3337), np.rint(np.clip(UNIT * 1.3337, 0, 1) * 255)),
        (coloured(np.column_stack([np.ones(12), UNIT])), BYTES),
        (coloured(UNIT, behind=" 1"), BYTES),
        (coloured(UNIT, behind=" 0.5"), BYTES),
        (coloured((UNIT > 0.5).astype(float)), 255 * (UNIT > 0.5)),
        (coloured(np.zeros((12, 3))), np.zeros((12, 3))),
        (FEW, [[0, 0, 0]] * 4 + [[255, 128, 0]] * 8),
    ],
)
def test_colours_are_scaled_by_what_most_of_them_are(text: str, expected: np.ndarray, tmp_path: Path):
    found = read(tmp_path, text)
    np.testing.assert_array_equal(found.colours, expected)
    np.testing.assert_array_equal(found.mesh.vertices, POINTS.astype(np.float32))


@pytest.mark.parametrize(
    "spelled", ["nan nan nan", "1 nan 0", "-nan(ind) 0 0", "1.#QNAN 0 0", "inf 0 0", "0 -1.#IND 0"]
)
def test_a_colour_that_is_no_number_costs_itself(spelled: str, tmp_path: Path):
    lines = coloured(UNIT).split("\n")
    lines[5] = " ".join([*V[5].split(), spelled])
    found = read(tmp_path, "\n".join(lines))
    expected = BYTES.copy()
    expected[5] = 0
    np.testing.assert_array_equal(found.colours, expected)
    assert found.notes == ("1 of 12 colours are no numbers: black",)


@pytest.mark.parametrize("vt", ["vt nan nan", "vt 0 inf", "vt -1.#IND 0", "vt 1.#QNAN 1.#QNAN", "vt -nan(ind) 1"])
def test_a_texture_coordinate_that_is_no_number_costs_the_uvs_alone(vt: str, tmp_path: Path):
    found = read(tmp_path, PLAIN.replace(VT[2], vt))
    np.testing.assert_array_equal(found.mesh.faces, FACES)
    used = np.count_nonzero(WEDGES == 2)
    assert used
    assert found.mesh.uv is None
    assert found.notes == (f"{used} of 27 corners have no UVs: the mesh is without",)


def test_faces_with_and_without_texture_coordinates(tmp_path: Path):
    found = read(tmp_path, PLAIN + "f 1 2 3\nf 1//1 2//1 3//1\n")
    assert (len(found.mesh.faces), found.mesh.uv) == (11, None)
    assert found.notes == ("6 of 33 corners have no UVs: the mesh is without",)
    one = read(tmp_path, "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0.25\nf 1/1 2/1 3/1\n").mesh.uv
    assert one is not None
    assert one.tolist() == [[[0.25, 0]] * 3]


THREE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (PLAIN.encode("utf-16"), "x.obj: expected UTF-8, found UTF-16 text"),
        (PLAIN.encode("utf-16-le"), "x.obj: expected UTF-8, found UTF-16 text"),
        (b"\xfe\xff" + PLAIN.encode("utf-16-be"), "x.obj: expected UTF-8, found UTF-16 text"),
        (THREE + "v 0,5 1,5 0\n", "x.obj:4: expected numbers, found '0,5 1,5 0'"),
        (THREE + "v 1_0 0 0\n", "x.obj:4: expected numbers"),
        (THREE + "v 0x10 0 0\n", "x.obj:4: expected numbers"),
        (THREE + "v 1.5-2 0\n", "x.obj:4: expected numbers"),
        (THREE + "v 1.#QNAN 0 0\n", "x.obj:4: expected finite numbers"),
        (THREE + "v 1e999 0 0\n", "x.obj:4: expected finite numbers"),
        (THREE + "v\n", "x.obj:4: expected at least 3 numbers, found 0"),
        (THREE + "vt\n", "x.obj:4: expected at least 1 number, found 0"),
        (THREE + "f\n", "x.obj:4: expected a face of at least 3 corners, found 0"),
        (THREE + "f 1.0 2.0 3.0\n", "x.obj:4: expected an index, found '1.0'"),
        (THREE + "f 1 2 /3\n", "x.obj:4: expected an index, found ''"),
        (THREE + "f 1/0 2/1 3/1\n", "x.obj:4: expected an index from 1"),
        (THREE + "f 1 2 \\\n  \\\n 4\n", "x.obj:4: vertex 4 does not exist, the file has 3"),
        (THREE + "\r\n\rf 1 2 \\\r 5\r", "x.obj:6: vertex 5 does not exist"),
        (THREE + "f -4 -2 -1\n", "x.obj:4: expected an index from 1, or from -1 down to -3, found -4"),
        (THREE + "f 1 2 2147483648\n", "x.obj:4: expected an index of at most 2147483647"),
        (THREE + "f 1 2 ٣\n", "x.obj:4: expected an index"),
        ("<html>\n<body>404</body>\n", "x.obj:1: not an OBJ file, found '<html>'"),
        ("# v\n\nply\nformat ascii 1.0\n", "x.obj:3: not an OBJ file, found 'ply'"),
        (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + bytes(range(256)), "x.obj:1: not an OBJ file"),
        ("version https://git-lfs.github.com/spec/v1\n", "x.obj:1: not an OBJ file"),
        ("v 1" + "1" * 100_000 + "x 0 0\n", "x.obj:1: expected numbers"),
    ],
)
def test_what_is_wrong_is_a_line(text: str | bytes, said: str, tmp_path: Path):
    with pytest.raises(InputError, match=re.escape(said)) as caught:
        read(tmp_path, text)
    assert isinstance(caught.value, NotFiniteError) == ("finite" in said)
    assert "\n" not in str(caught.value)


def test_a_cloud_of_points_is_read_where_no_faces_are_needed(tmp_path: Path):
    (tmp_path / "x.obj").write_text(coloured(UNIT).partition("\nf")[0])
    found = read_mesh(tmp_path / "x.obj", faces_needed=False)
    assert found.mesh.faces.shape == (0, 3)
    np.testing.assert_array_equal(found.colours, BYTES)
    with pytest.raises(InputError, match="empty mesh, found 12 vertices and no faces"):
        read_mesh(tmp_path / "x.obj")
    (tmp_path / "x.obj").write_text("# nothing\n\nmtllib x.mtl\no nothing\n")
    with pytest.raises(InputError, match="empty mesh, found 0 vertices"):
        read_mesh(tmp_path / "x.obj", faces_needed=False)
