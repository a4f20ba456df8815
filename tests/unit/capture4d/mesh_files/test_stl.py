"""STL files, against trimesh and against what they were made of."""

import re
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from capture4d.errors import EmptyMeshError, InputError
from capture4d.mesh_files.meshes import read_coloured_mesh, read_mesh, write_mesh
from capture4d.mesh_files.polygons import MeshFile
from capture4d.mesh_files.stl import welded

BALL = trimesh.creation.icosphere(subdivisions=2)
TRIANGLES = np.asarray(BALL.triangles, np.float32)


def binary(triangles: np.ndarray, head: bytes = b"", count: int | None = None) -> bytes:
    records = np.zeros(len(triangles), [("normal", "<f4", 3), ("points", "<f4", (3, 3)), ("attributes", "<u2")])
    records["points"] = triangles
    return head.ljust(80, b"\0") + struct.pack("<I", len(triangles) if count is None else count) + records.tobytes()


def facets(triangles: np.ndarray) -> str:
    return "".join(
        "  facet normal 0 0 1\n    outer loop\n"
        + "".join(f"      vertex {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in triangle)
        + "    endloop\n  endfacet\n"
        for triangle in triangles.tolist()
    )


def text(triangles: np.ndarray = TRIANGLES, name: str = "ball") -> str:
    return f"solid {name}\n{facets(triangles)}endsolid {name}\n"


def read(folder: Path, data: str | bytes) -> MeshFile:
    (folder / "x.stl").write_bytes(data if isinstance(data, bytes) else data.encode())
    return read_mesh(folder / "x.stl")


SPELLINGS = {
    "binary": binary(TRIANGLES),
    "binary that begins with solid": binary(TRIANGLES, b"solid made by a program"),
    "binary with a colour": binary(TRIANGLES, b"COLOR=\1\2\3\4"),
    "binary, a few bytes behind": binary(TRIANGLES) + b"\0\0\n",
    "text": text(),
    "text without a name": text(name=""),
    "CRLF": text().replace("\n", "\r\n"),
    "CR": text().replace("\n", "\r"),
    "tabs": text().replace("  ", "\t"),
    "no indents": re.sub(r"(?m)^ +", "", text()),
    "capitals": text().upper(),
    "blank lines": text().replace("\n", "\n\n"),
    "byte order mark": "\ufeff" + text(),
    "two solids": text(TRIANGLES[:100], "a") + text(TRIANGLES[100:], "vertex 1 2 3"),
    "a name in latin-1": text(name="Größe").encode("latin-1"),
    "no line end": text().rstrip(),
}


@pytest.mark.parametrize("name", SPELLINGS)
def test_triangles_however_they_are_written(name: str, tmp_path: Path):
    found = read(tmp_path, SPELLINGS[name])
    np.testing.assert_array_equal(found.mesh.vertices[found.mesh.faces], TRIANGLES)
    assert len(found.mesh.vertices) == len(BALL.vertices)
    assert found.mesh.faces.reshape(-1)[0] == 0
    assert (np.diff(np.maximum.accumulate(found.mesh.faces.reshape(-1))) <= 1).all(), "in the order they are seen"
    assert (found.colours, found.mesh.uv, found.notes) == (None, None, ())


@pytest.mark.parametrize("kind", ["stl", "stl_ascii"])
def test_trimesh_agrees(kind: str, tmp_path: Path):
    data = BALL.export(file_type=kind)
    found = read(tmp_path, data)
    theirs = trimesh.load(tmp_path / "x.stl")
    assert isinstance(theirs, trimesh.Trimesh)
    assert (len(theirs.vertices), theirs.is_watertight) == (len(found.mesh.vertices), True)
    np.testing.assert_allclose(found.mesh.vertices[found.mesh.faces], theirs.triangles, atol=1e-7)


def test_it_goes_in_and_not_out(tmp_path: Path):
    (tmp_path / "x.STL").write_text(text())
    assert read_coloured_mesh(tmp_path / "x.STL").colours is None
    with pytest.raises(InputError, match=r"expected a mesh file \(.obj, .ply, .glb, .off\), found '.stl'"):
        write_mesh(tmp_path / "y.stl", read_mesh(tmp_path / "x.STL").mesh)


@given(
    hnp.arrays(np.float32, st.tuples(st.integers(0, 30), st.just(3)), elements=st.sampled_from([0.0, -0.0, 1.0, 2.5]))
)
def test_welding_joins_what_is_equal_and_nothing_else(points: np.ndarray):
    vertices, which = welded(points)
    np.testing.assert_array_equal(vertices[which], points)
    assert len(np.unique(vertices, axis=0)) == len(vertices)
    seen: list[list[float]] = []
    for point in points.tolist():
        seen += [] if point in seen else [point]
    assert vertices.tolist() == seen


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (binary(TRIANGLES)[:-1], "cut off or damaged, expected 320 triangles, found the bytes of 319"),
        (binary(TRIANGLES, count=321), "expected 321 triangles, found the bytes of 320"),
        (binary(TRIANGLES, count=2**32 - 1), "expected 4294967295 triangles, found the bytes of 320"),
        (binary(TRIANGLES, count=0), "expected 0 triangles, found the bytes of 320"),
        (b"", "cut off: expected 84 bytes or more, found 0"),
        (b"short", "cut off"),
        (text().removesuffix("endsolid ball\n"), "cut off, expected 'endsolid' in the end, after 320 whole triangles"),
        (text()[:500], "cut off, expected 'endsolid'"),
        (text().replace("endloop", "", 1), "x.stl:8: expected 'endloop', found 'endfacet'"),
        (text().replace("    outer loop\n", "", 2), "x.stl:3: expected 'outer loop', found 'vertex"),
        (text().replace("endloop", "vertex 1 2 3\nendloop", 1), "x.stl:7: expected 'endloop', found 'vertex 1 2 3'"),
        (re.sub(r"vertex (\S+)", "vertex x", text(), count=1), "x.stl:4: expected numbers, found 'x"),
        (re.sub(r"vertex (\S+) (\S+)", "vertex 1", text(), count=1), "x.stl:4: expected at least 3 numbers, found 2"),
        (re.sub(r"vertex (\S+)", "vertex nan", text(), count=1), "expected finite numbers"),
        (text().replace("vertex", "vortex", 1), "x.stl:4: expected a line of 'vertex x y z'"),
        ("<html>not found</html>" * 10, "expected"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_one_line(data: str | bytes, said: str, tmp_path: Path):
    with pytest.raises(InputError, match=re.escape(said)) as caught:
        read(tmp_path, data)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("data", [binary(TRIANGLES[:0]), "solid nothing\nendsolid\n"])
def test_no_triangle_is_an_empty_mesh(data: str | bytes, tmp_path: Path):
    with pytest.raises(EmptyMeshError):
        read(tmp_path, data)
