"""PLY files as other programs write them, against what they were made of and against trimesh."""

import itertools
import re
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from capture4d.errors import EmptyMeshError, InputError
from capture4d.mesh_files.meshes import read_coloured_mesh, read_mesh
from capture4d.mesh_files.polygons import MeshFile

LETTERS = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}
LETTERS |= {"int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "float32": "f"}
LETTERS |= {"float64": "d", "int64": "q", "uint64": "Q"}
FORMATS = ("ascii", "binary_little_endian", "binary_big_endian")
POINTS = [[0, 0, 0], [1, 0, 0.25], [1, 1, 0], [0, 1, 0.5], [2, 0, 0]]
BYTES = [[0, 7, 255], [200, 100, 50], [1, 2, 3], [127, 128, 129], [255, 255, 0]]
XYZ = ["float x", "float y", "float z"]
RGB = ["red", "green", "blue"]
POLYGONS: list[list[Any]] = [[[0, 1, 2, 3]], [[1, 4, 2]]]
TRIANGLES = [[0, 1, 2], [0, 2, 3], [1, 4, 2]]

Element = tuple[str, Sequence[str], Sequence[Sequence[Any]]]


def ply(form: str, *elements: Element, comments: str = "") -> bytes:
    """A file of elements: name, its properties, and a row of values, or lists of them, a record."""
    head, body = f"ply\nformat {form} 1.0\n{comments}", b""
    order = ">" if form.endswith("big_endian") else "<"
    for name, properties, records in elements:
        head += f"element {name} {len(records)}\n" + "".join(f"property {each}\n" for each in properties)
        for record in records:
            words: list[str] = []
            for described, value in zip(properties, record, strict=True):
                *_, length, kind, _ = ["", *described.split()]
                values = value if isinstance(value, list) else [value]
                if isinstance(value, list):
                    words.append(f"{len(value)}")
                    body += b"" if form == "ascii" else struct.pack(f"{order}{LETTERS[length]}", len(value))
                words += [f"{each:.9g}" for each in values]
                body += b"" if form == "ascii" else struct.pack(f"{order}{len(values)}{LETTERS[kind]}", *values)
            body += f"{' '.join(words)}\n".encode() if form == "ascii" else b""
    return f"{head}end_header\n".encode() + body


def read(folder: Path, data: bytes, *, coloured: bool = False) -> MeshFile:
    path = folder / "x.ply"
    path.write_bytes(data)
    return read_coloured_mesh(path) if coloured else read_mesh(path)


def faces(kind: str = "int", length: str = "uchar", name: str = "vertex_indices", rows: Any = POLYGONS) -> Element:
    return "face", [f"list {length} {kind} {name}"], rows


def vertices(*more: str, rows: Sequence[Sequence[Any]] = (), axes: Sequence[str] = XYZ) -> Element:
    return "vertex", [*axes, *more], [[*point, *row] for point, row in zip(POINTS, rows or [[]] * 5, strict=True)]


INTEGERS = ("char", "uchar", "short", "ushort", "int", "uint", "int64", "uint64", "int8", "uint16", "int32")


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize(("length", "kind"), [*zip(INTEGERS, INTEGERS[::-1], strict=True), ("uchar", "int")])
def test_lists_of_any_types(form: str, length: str, kind: str, tmp_path: Path):
    found = read(tmp_path, ply(form, vertices(), faces(kind, length)))
    assert found.mesh.faces.tolist() == TRIANGLES
    assert found.mesh.vertices.tolist() == POINTS
    assert found.polygon_sizes is not None
    assert found.polygon_sizes.tolist() == [4, 3]


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("name", ["vertex_index", "vertex_indices", "vertex_indexes"])
@pytest.mark.parametrize("axes", [XYZ, ["double z", "double y", "double x"], ["short x", "float32 y", "float64 z"]])
def test_trimesh_agrees(form: str, name: str, axes: list[str], tmp_path: Path):
    rows = [[[int(corner) for corner in row]] for row in TRIANGLES]
    points = [list(dict(zip([axis[-1] for axis in axes], point, strict=True)).values()) for point in POINTS]
    colours = [f"uchar {channel}" for channel in RGB]
    records = [[*point, *colour] for point, colour in zip(points, BYTES, strict=True)]
    found = read(tmp_path, ply(form, ("vertex", [*axes, *colours], records), faces(name=name, rows=rows)))
    if name == "vertex_indexes":  # which trimesh does not know
        assert found.mesh.faces.tolist() == TRIANGLES
        return
    theirs = trimesh.load(tmp_path / "x.ply", process=False)
    assert isinstance(theirs, trimesh.Trimesh)
    np.testing.assert_array_equal(found.mesh.vertices, theirs.vertices)
    np.testing.assert_array_equal(found.mesh.faces, theirs.faces)
    np.testing.assert_array_equal(found.colours, theirs.visual.vertex_colors[:, :3])


def units(byte: float) -> float:
    return byte / 255


COLOURS = {
    "uchar": [[int(byte) for byte in row] for row in BYTES],
    "char": [[byte - 256 if byte > 127 else byte for byte in row] for row in BYTES],
    "ushort": [[257 * byte for byte in row] for row in BYTES],
    "short": BYTES,
    "int": BYTES,
    "uint": BYTES,
    "float": [[units(byte) for byte in row] for row in BYTES],
    "double": [[units(byte) for byte in row] for row in BYTES],
}


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("kind", COLOURS)
@pytest.mark.parametrize("names", [RGB, ["r", "g", "b"], ["diffuse_red", "diffuse_green", "diffuse_blue"]])
def test_colours_are_scaled_by_their_type(form: str, kind: str, names: list[str], tmp_path: Path):
    data = ply(form, vertices(*(f"{kind} {name}" for name in names), rows=COLOURS[kind]), faces())
    found = read(tmp_path, data)
    np.testing.assert_array_equal(found.colours, BYTES)
    assert found.notes == ()


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize(
    ("kind", "given", "expected"),
    [
        ("ushort", [0, 128, 1], [0, 0, 0]),
        ("ushort", [65535, 32896, 257], [255, 128, 1]),
        ("float", [0, 1, 1.0003], [0, 255, 255]),
        ("float", [0, 1.2, 0.5], [0, 255, 128]),
        ("double", [1e-9, 1 + 1e-9, 1], [0, 255, 255]),
        ("float", [-0.1, 0.5, 1], [0, 128, 255]),
        ("float", [0, 255, 17], [0, 255, 17]),
        ("float", [0.25, 254.5, 17.2], [0, 254, 17]),
        ("int", [-3, 300, 12], [0, 255, 12]),
        ("uchar", [1, 1, 0], [1, 1, 0]),
    ],
)
def test_never_by_the_largest_value(form: str, kind: str, given: list[Any], expected: list[int], tmp_path: Path):
    properties = [f"{kind} {channel}" for channel in RGB]
    found = read(tmp_path, ply(form, vertices(*properties, rows=[given] * 5), faces()))
    np.testing.assert_array_equal(found.colours, [expected] * 5)


def test_a_few_bright_numbers_do_not_darken_the_rest(tmp_path: Path):
    rng = np.random.default_rng(0)
    points, colours = rng.random((400, 3)), rng.random((400, 3))
    expected = np.rint(colours * 255)
    colours[7], expected[7] = (40.0, 1.5, 1e30), 255
    rows = np.column_stack([points, colours]).tolist()
    data = ply("binary_little_endian", ("vertex", [*XYZ, *(f"double {name}" for name in RGB)], rows), faces())
    np.testing.assert_array_equal(read(tmp_path, data).colours, expected)


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_no_number_costs_itself(form: str, bad: float, tmp_path: Path):
    rows = [[*colour, *point[:2]] for colour, point in zip(COLOURS["float"], POINTS, strict=True)]
    rows[3] = [bad, 0.5, 0.5, 0, bad]
    data = ply(form, vertices(*(f"float {name}" for name in RGB), "float s", "float t", rows=rows), faces())
    found = read(tmp_path, data)
    np.testing.assert_array_equal(found.colours, [*BYTES[:3], [0, 0, 0], BYTES[4]])
    assert found.mesh.uv is None
    assert found.notes == (
        "1 of 7 corners have no UVs: the mesh is without",
        "1 of 5 colours are no numbers: black",
    )


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("names", ["s t", "u v", "texture_u texture_v", "texture_s texture_t", "texcoord_u texcoord_v"])
def test_uvs_of_vertices(form: str, names: str, tmp_path: Path):
    uv = [point[:2] for point in POINTS]
    found = read(tmp_path, ply(form, vertices(*(f"float {name}" for name in names.split()), rows=uv), faces()))
    np.testing.assert_array_equal(found.mesh.uv, np.array(uv)[np.array(TRIANGLES)])


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("length", ["uchar", "int", "short"])
def test_uvs_of_faces_and_what_stands_around(form: str, length: str, tmp_path: Path):
    """Elements before and after, numbers and lists of other lengths between."""
    uv = [[0, 0, 1, 0, 1, 1, 0, 1], [0.25, 0.5, 0.75, 0.5, 0.5, 1]]
    listed = [
        [7, POLYGONS[0][0], [], uv[0], -1],
        [8, POLYGONS[1][0], [1, 2, 3], uv[1], -1],
    ]
    properties = ["uchar flags", f"list {length} int vertex_index", "list uchar uchar extra"]
    properties += [f"list {length} float texcoord", "short group"]
    found = read(
        tmp_path,
        ply(
            form,
            ("camera", ["float view", "list uchar int sees"], [[1.5, [1, 2]], [2.5, []]]),
            vertices("float nx", "uchar quality", rows=[[0.5, 3]] * 5),
            ("edge", ["int vertex1", "int vertex2"], [[0, 1], [1, 2]]),
            ("face", properties, listed),
            ("tail", ["list uint double numbers"], [[[1.5]], [[]]]),
        ),
    )
    assert found.mesh.faces.tolist() == TRIANGLES
    corners = np.array(uv[0]).reshape(4, 2)
    assert found.mesh.uv is not None
    np.testing.assert_array_equal(found.mesh.uv[:2], corners[np.array([[0, 1, 2], [0, 2, 3]])])
    np.testing.assert_array_equal(found.mesh.uv[2], np.array(uv[1]).reshape(3, 2))


@pytest.mark.parametrize("form", FORMATS)
def test_uvs_of_some_faces(form: str, tmp_path: Path):
    rows = [[POLYGONS[0][0], []], [POLYGONS[1][0], [0, 0, 1, 0, 1, 1]]]
    data = ply(form, vertices(), ("face", ["list uchar int vertex_indices", "list uchar float texcoord"], rows))
    found = read(tmp_path, data)
    assert found.mesh.uv is None
    assert found.notes == ("4 of 7 corners have no UVs: the mesh is without",)


@pytest.mark.parametrize("form", FORMATS)
def test_strips_of_triangles_wind_one_way(form: str, tmp_path: Path):
    strip = [0, 1, 2, 3, 4, -1, 4, 3, 2, -1, -1, 1, 2, 2, 3]
    data = ply(form, vertices(), ("tristrips", ["list int int vertex_indices"], [[strip], [[2, 3, 4]]]))
    expected = [[0, 1, 2], [2, 1, 3], [2, 3, 4], [4, 3, 2], [2, 3, 4]]
    assert read(tmp_path, data).mesh.faces.tolist() == expected


@pytest.mark.parametrize("form", FORMATS)
def test_colours_of_faces_are_the_mean_at_a_vertex(form: str, tmp_path: Path):
    channels = [f"uchar {name}" for name in RGB]
    rows = [[POLYGONS[0][0], 10, 20, 30], [POLYGONS[1][0], 100, 110, 120]]
    found = read(tmp_path, ply(form, vertices(), ("face", ["list uchar int vertex_indices", *channels], rows)))
    assert found.colours is not None
    assert found.colours[[0, 1, 3, 4]].tolist() == [[10, 20, 30], [55, 65, 75], [10, 20, 30], [100, 110, 120]]


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("properties", [XYZ, [*XYZ, "uchar red", "uchar green", "uchar blue"]])
def test_an_empty_frame_is_an_empty_mesh(form: str, properties: list[str], tmp_path: Path):
    data = ply(form, ("vertex", properties, []), ("face", ["list uchar int vertex_indices"], []))
    for text in (data, data.partition(b"element face")[0] + b"end_header\n"):
        with pytest.raises(EmptyMeshError, match=r"x\.ply: empty mesh, found 0 vertices and no faces$"):
            read(tmp_path, text)


@pytest.mark.parametrize("form", FORMATS)
def test_a_cloud_is_read_where_no_faces_are_needed(form: str, tmp_path: Path):
    path = tmp_path / "x.ply"
    path.write_bytes(ply(form, vertices(*(f"uchar {name}" for name in RGB), rows=BYTES)))
    found = read_coloured_mesh(path, faces_needed=False)
    assert (found.mesh.vertices.tolist(), found.mesh.faces.shape) == (POINTS, (0, 3))
    np.testing.assert_array_equal(found.colours, BYTES)
    with pytest.raises(EmptyMeshError):
        read_mesh(path)


TEXT = ply("ascii", vertices(*(f"uchar {name}" for name in RGB), rows=BYTES), faces()).decode()
HEAD, END, BODY = TEXT.partition("end_header\n")
BINARY = ply("binary_little_endian", vertices(*(f"uchar {name}" for name in RGB), rows=BYTES), faces())
BINARY_HEAD, _, BINARY_BODY = BINARY.partition(b"end_header\n")
NOISE = (
    "comment element vertex 7\ncomment end_header\ncomment property float w\nobj_info element face 9\n"
    "comment made by x\x85element vertex 3\nobj_info num_cols 512\n"
)
SPELLINGS: dict[str, bytes] = {
    "as it is": TEXT.encode(),
    "byte order mark": b"\xef\xbb\xbf" + TEXT.encode(),
    "CRLF": TEXT.replace("\n", "\r\n").encode(),
    "CR": TEXT.replace("\n", "\r").encode(),
    "CRLF in the head only": (HEAD + END).replace("\n", "\r\n").encode() + BODY.encode(),
    "mixed line ends": TEXT.replace("\n", "\r\n", 4).replace("vertex 5\n", "vertex 5\r").encode(),
    "blanks behind the lines of the head": (HEAD + END).replace("\n", " \t\n").encode() + BODY.encode(),
    "tabs": TEXT.replace(" ", "\t").encode(),
    "capitals": TEXT.replace("ascii", "ASCII").replace("float", "FLOAT").replace("uchar", "UChar").encode(),
    "capital names": TEXT.replace(" x\n", " X\n").replace(" red", " Red").encode(),
    "comments with key words": (HEAD + NOISE + END + BODY).encode("latin-1"),
    "comments first": TEXT.replace("ply\n", f"ply\n{NOISE}").encode("latin-1"),
    "blank lines": (HEAD + "\n" + END + BODY.replace("\n", "\n\n")).encode(),
    "numbers that nobody declared": (HEAD + END + BODY.replace("\n", " 6 0 0 1 0 1 1\n")).encode(),
    "numbers behind the faces": (HEAD + END + BODY.replace("2 3\n", "2 3 255 255 255\n")).encode(),
    "lines behind the end": TEXT.encode() + b"7 7 7\nwhat is this\n",
    "all in one line": (HEAD + END + BODY.replace("\n", " ")).encode(),
    "records of two lines": (
        HEAD + END + re.sub(r"^(\S+ \S+ \S+) (?=\S+ \S+ \S+$)", "\\1\n", BODY, flags=re.M)
    ).encode(),
    "whole numbers with a point": (HEAD + END + BODY.replace(" 1 2\n", " 1.0 2.0\n")).encode(),
    "indented": (HEAD + END + BODY.replace("\n", "\n  ")).encode(),
    "binary": BINARY,
    "binary, head CRLF": BINARY_HEAD.replace(b"\n", b"\r\n") + b"end_header\r\n" + BINARY_BODY,
    "binary, head CR": BINARY_HEAD.replace(b"\n", b"\r") + b"end_header\r" + BINARY_BODY,
    "binary, blanks": BINARY_HEAD.replace(b"\n", b" \n") + b"end_header  \n" + BINARY_BODY,
    "binary, bytes behind": BINARY + b"\0\0\0",
    "binary, comments": BINARY_HEAD + NOISE.encode("latin-1") + b"end_header\n" + BINARY_BODY,
}


@pytest.mark.parametrize("name", SPELLINGS)
def test_the_same_mesh_however_it_is_spelled(name: str, tmp_path: Path):
    found = read(tmp_path, SPELLINGS[name])
    assert found.mesh.faces.tolist() == TRIANGLES
    assert found.mesh.vertices.tolist() == POINTS
    np.testing.assert_array_equal(found.colours, BYTES)


@pytest.mark.parametrize(("first", "ends"), [*itertools.product([10, 13], ["\n", "\r\n", "\r"])])
def test_a_body_may_begin_with_the_byte_of_a_line_end(first: int, ends: str, tmp_path: Path):
    """After a head that ends its lines with CR, a byte 10 is the first of the body."""
    data = ply("binary_little_endian", ("tag", ["uchar value"], [[first]]), vertices(), faces())
    head, _, body = data.partition(b"end_header\n")
    found = read(tmp_path, (head + b"end_header\n").replace(b"\n", ends.encode()) + body)
    assert found.mesh.vertices.tolist() == POINTS


LINE = len((HEAD + END).splitlines())


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (TEXT.replace("1 4 2\n", "1 4\n"), f"x.ply:{LINE + 7}: expected more numbers, for vertex_indices, found 3"),
        (TEXT.replace("1 0 0.25 ", "1 0 "), f"x.ply:{LINE + 2}: expected more numbers, for blue, found 5"),
        (TEXT.replace("1 0 0.25 ", "1 O 0.25 "), f"x.ply:{LINE + 2}: expected numbers, found '1 O 0.25"),
        (TEXT.replace("1 0 0.25 200", "1 0 0.25 256"), f"x.ply:{LINE + 2}: expected red from 0 to 255, found 256"),
        (TEXT.replace("3 1 4 2", "3 1 4 2.5"), f"x.ply:{LINE + 7}: expected vertex_indices from"),
        (TEXT.replace("3 1 4 2", "3.5 1 4 2"), f"x.ply:{LINE + 7}: expected more numbers"),
        (TEXT.replace("3 1 4 2", "nan 1 4 2"), f"x.ply:{LINE + 7}: expected more numbers"),
        (TEXT.replace("3 1 4 2", "-3 1 4 2"), f"x.ply:{LINE + 7}: expected more numbers"),
        (TEXT.replace("3 1 4 2", "4000000000 1 4 2"), f"x.ply:{LINE + 7}: expected more numbers"),
        (TEXT.replace("3 1 4 2", "3 1 4 5"), "expected vertex indices from 0 to 4, found 0..5"),
        (TEXT.replace("3 1 4 2", "2 1 4"), "face 1: expected at least 3 corners, found 2"),
        (TEXT.replace("3 1 4 2\n", ""), "x.ply: cut off, expected 2 records of 'face', found 1"),
        (TEXT.replace("1 0 0.25", "1 nan 0.25"), "expected finite numbers"),
        (TEXT.replace("element vertex 5", "element vertex five"), "cannot read 'element vertex five'"),
        (TEXT.replace("element vertex 5", "element vertex -5"), "damaged header"),
        (TEXT.replace("element vertex 5", "element vertex"), "damaged header"),
        (TEXT.replace("property float z", "property float"), "damaged header, cannot read 'property float'"),
        (TEXT.replace("property float z", "property real z"), "damaged header"),
        (TEXT.replace("property float z", "property float w"), "expected vertices with x, y and z, found x, y, w"),
        (TEXT.replace("float z", "float x"), "damaged header"),
        (TEXT.replace("end_header", "end_headers"), "cut off in the header"),
        (TEXT.replace("format ascii", "format text"), "damaged header"),
        (TEXT.encode("utf-16"), "not a PLY file"),
        (TEXT.replace("ply", "obj", 1), "not a PLY file"),
        (b"", "not a PLY file"),
        (TEXT.replace("uchar int", "float int"), "damaged header"),
        (TEXT.replace("uchar int", "uchar float"), "expected whole numbers as vertex_indices"),
    ],
)
def test_what_is_wrong_is_one_line(data: str | bytes, said: str, tmp_path: Path):
    with pytest.raises(InputError, match=re.escape(said)) as caught:
        read(tmp_path, data if isinstance(data, bytes) else data.encode())
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("form", FORMATS[1:])
def test_a_binary_file_of_mixed_polygons_cut_off_anywhere(form: str, tmp_path: Path):
    data = ply(
        form, vertices(), ("face", ["list uchar int vertex_index", "short group"], [[[0, 1, 2, 3], 1], [[1, 4, 2], 2]])
    )
    for length in range(len(data)):
        with pytest.raises(InputError):
            read(tmp_path, data[:length])


def test_a_head_of_many_lines_is_read_at_once(tmp_path: Path):
    many = "".join(f"element e{index} 0\nproperty float p\n" for index in range(20_000))
    wide = "".join(f"property float p{index}\n" for index in range(20_000))
    for data in (
        TEXT.replace("element vertex", f"{many}element vertex"),
        TEXT.replace("element face", f"element e 0\n{wide}element face"),
    ):
        assert read(tmp_path, data.encode()).mesh.faces.tolist() == TRIANGLES


@pytest.mark.parametrize("channel", ["red", "g", "diffuse_blue"])
def test_a_colour_that_is_a_list_is_none(channel: str, tmp_path: Path) -> None:
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    tail = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    rows = "0 0 0 1 5\n1 0 0 2 5 5\n0 1 0 1 5\n3 0 1 2\n"
    (tmp_path / "a.ply").write_text(f"{head}property list uchar uchar {channel}\n{tail}{rows}")
    with pytest.raises(InputError, match=f"expected one number called {channel} in every vertex, found a list"):
        read_mesh(tmp_path / "a.ply")


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_records_without_a_property_are_refused(form: str, tmp_path: Path) -> None:
    head = f"ply\nformat {form} 1.0\nelement junk 4000000000\nelement vertex 0\nproperty float x\nend_header\n"
    (tmp_path / "a.ply").write_text(head)
    with pytest.raises(InputError, match="4000000000 records of 'junk' have no property"):
        read_mesh(tmp_path / "a.ply")
