"""Mesh files as other programs write them, and as they should not be."""

import re
import struct
from pathlib import Path

import numpy as np
import pytest

from capture4d.errors import InputError
from capture4d.mesh_files.meshes import read_coloured_mesh, read_mesh, write_mesh
from capture4d.types import Mesh

QUAD_AND_TRIANGLE = """\
# two faces; a stray vertex; tabs, UV seam, comment
v 0 0 0
v\t1 0 0
v 1 1 0
v 0 1 0
v 9 9 9
v 2 0 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
vt .5 .5
f 1/1/1 2/2/1 3/3/1 4/4/1
f -5/5 -1/2 -4/3
"""


def test_obj_keeps_vertices_polygons_and_corner_uvs(tmp_path: Path):
    path = tmp_path / "quad.obj"
    path.write_text(QUAD_AND_TRIANGLE)
    found = read_mesh(path)
    assert len(found.mesh.vertices) == 6  # nothing split at the seam, nothing dropped
    assert found.mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [1, 5, 2]]
    assert found.polygon_sizes is not None
    assert found.polygon_sizes.tolist() == [4, 3]
    assert found.mesh.uv is not None
    assert found.mesh.uv[1].tolist() == [[0, 0], [1, 1], [0, 1]]
    assert found.mesh.uv[2].tolist() == [[0.5, 0.5], [1, 0], [1, 1]]


@pytest.mark.parametrize("suffix", [".obj", ".ply"])
def test_polygons_and_uvs_survive_writing(tmp_path: Path, suffix: str):
    source, copy = tmp_path / "quad.obj", tmp_path / f"copy{suffix}"
    source.write_text(QUAD_AND_TRIANGLE)
    first = read_mesh(source)
    write_mesh(copy, first.mesh, polygon_sizes=first.polygon_sizes)
    again = read_mesh(copy)
    np.testing.assert_array_equal(again.mesh.vertices, first.mesh.vertices)
    np.testing.assert_array_equal(again.mesh.faces, first.mesh.faces)
    np.testing.assert_array_equal(again.mesh.uv, first.mesh.uv)
    np.testing.assert_array_equal(again.polygon_sizes, first.polygon_sizes)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("v 0 0 0\nv 1 0 zero\n", "bad.obj:2: expected numbers"),
        ("v 0 0 0\nv 1 nan 0\n", "bad.obj:2: expected finite"),
        ("v 0 0\n", "bad.obj:1: expected at least 3 numbers"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\n\nf 1 2 4\n", "bad.obj:5: vertex 4 does not exist"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "bad.obj:4: expected an index from 1"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf -4 1 2\n", "bad.obj:4: expected an index"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/7 2/7 3/7\n", "bad.obj:4: texture coordinate 7 does not exist"),
        (f"v 0 0 0\nf 1 2 {9**40}\n", "bad.obj:2: expected an index of at most 2147483647"),
        ("v 0 0 0\nv 1 0 0\nf 1 2\n", "bad.obj:3: expected a face of at least 3 corners"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "bad.obj: empty mesh, found 3 vertices and no faces"),
        ("", "bad.obj: empty mesh"),
    ],
)
def test_a_wrong_obj_names_the_line(tmp_path: Path, text: str, expected: str):
    path = tmp_path / "bad.obj"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_mesh(path)
    assert expected in str(caught.value)
    assert str(caught.value).count(str(tmp_path)) == 1


def test_ply_as_text_with_doubles_and_mixed_faces(tmp_path: Path):
    path = tmp_path / "text.ply"
    path.write_text(
        "ply\nformat ascii 1.0\ncomment made by hand\nelement vertex 5\nproperty double x\nproperty double y\n"
        "property double z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nproperty uchar alpha\n"
        "element face 2\nproperty list uchar uint vertex_index\nend_header\n"
        "0 0 0 255 0 0 255\n1 0 0 0 255 0 255\n1 1 0 0 0 255 255\n0 1 0 9 9 9 255\n2 0 0 1 2 3 255\n"
        "4 0 1 2 3\n3 1 4 2\n"
    )
    found = read_mesh(path)
    assert found.mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [1, 4, 2]]
    assert found.colours is not None
    assert found.colours[4].tolist() == [1, 2, 3]


def test_ply_big_endian_with_windows_line_ends(tmp_path: Path):
    path = tmp_path / "big.ply"
    header = (
        "ply\r\nformat binary_big_endian 1.0\r\nelement vertex 3\r\nproperty float x\r\nproperty float y\r\n"
        "property float z\r\nelement face 1\r\nproperty list uchar int vertex_indices\r\nend_header\r\n"
    )
    path.write_bytes(
        header.encode() + struct.pack(">9f", 0, 0, 0, 1, 0, 0, 0, 1, 0.5) + struct.pack(">B3i", 3, 0, 1, 2)
    )
    found = read_mesh(path)
    assert found.mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0.5]]
    assert found.mesh.faces.tolist() == [[0, 1, 2]]


def test_a_ply_cut_off_anywhere_is_one_clear_error(tmp_path: Path):
    rng = np.random.default_rng(0)
    mesh = Mesh(rng.random((30, 3), np.float32), rng.integers(0, 30, (50, 3)).astype(np.int32))
    whole, cut = tmp_path / "whole.ply", tmp_path / "cut.ply"
    write_mesh(whole, mesh, colours=rng.integers(0, 255, (30, 3)).astype(np.uint8))
    data = whole.read_bytes()
    for length in range(len(data)):
        cut.write_bytes(data[:length])
        with pytest.raises(InputError, match=r"cut\.ply: ") as caught:
            read_mesh(cut)
        assert "\n" not in str(caught.value)


def test_damaged_and_missing_files_are_named(tmp_path: Path):
    glb = tmp_path / "broken.glb"
    glb.write_bytes(b"glTF\x02\x00\x00\x00")
    for path, expected in (
        (glb, "broken.glb: not a readable GLB"),
        (tmp_path / "none.ply", "none.ply: no such mesh file"),
        (tmp_path / "scan.fbx", "scan.fbx: expected a mesh file"),
    ):
        with pytest.raises(InputError, match=expected):
            read_mesh(path)


def test_nan_in_a_ply_is_named(tmp_path: Path):
    path = tmp_path / "nan.ply"
    write_mesh(path, Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32)))
    head, body = path.read_bytes().split(b"end_header\n")
    path.write_bytes(head + b"end_header\n" + struct.pack("<f", np.nan) + body[4:])
    with pytest.raises(InputError, match=r"nan\.ply: Mesh\.vertices: expected finite numbers"):
        read_mesh(path)


@pytest.mark.parametrize("suffix", [".obj", ".glb"])
def test_a_texture_too_large_to_be_read_is_one_line(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import trimesh
    from PIL import Image

    picture = Image.fromarray(np.zeros((40, 40, 3), np.uint8))
    path = tmp_path / f"scan{suffix}"
    vertices, faces = np.eye(3), np.array([[0, 1, 2]])
    if suffix == ".glb":
        model = trimesh.Trimesh(vertices, faces, process=False)
        material = trimesh.visual.material.PBRMaterial(baseColorTexture=picture)
        model.visual = trimesh.visual.TextureVisuals(np.eye(3)[:, :2], material=material)
        path.write_bytes(trimesh.Scene(model).export(file_type="glb"))
    else:
        picture.save(tmp_path / "skin.png")
        (tmp_path / "scan.mtl").write_text("newmtl skin\nmap_Kd skin.png\n")
        path.write_text("mtllib scan.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n")
    assert read_coloured_mesh(path).colours is not None
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1000)
    assert suffix == ".glb" or read_coloured_mesh(path).colours is not None, "Pillow warns only"
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)
    with pytest.raises(InputError, match="too large"):
        read_coloured_mesh(path)


TEXT = "ply\nformat ascii 1.0\n{before}element vertex 3\n{axes}{colours}element face 1\n{corners}end_header\n{body}"
AXES = "property float x\nproperty float y\nproperty float z\n"
POINTS = "0 0 0\n1 0 0\n0 1 0\n"
LIST = "property list uchar int vertex_indices\n"
BINARY = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0)


def ply(corners: str = LIST, body: str = POINTS + "3 0 1 2\n", colours: str = "", before: str = "") -> bytes:
    return TEXT.format(before=before, axes=AXES, colours=colours, corners=corners, body=body).encode()


def binary(corners: str, body: bytes) -> bytes:
    return ply(corners, "").replace(b"ascii", b"binary_little_endian") + BINARY + body


RED = "property uchar red\nproperty uchar green\nproperty uchar blue\n"


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (ply("property int vertex_indices\n", POINTS + "3\n"), "expected a list of corners in every face"),
        (ply("property list uchar float vertex_indices\n"), "expected whole numbers as vertex_indices"),
        (ply("property list float int vertex_indices\n"), "damaged header"),
        (ply(before="element vertex 1\nproperty float x\n"), "damaged header, cannot read 'element vertex 3'"),
        (ply(body="0 0 0 300 0 0\n1 0 0 1 1 1\n0 1 0 1 1 1\n3 0 1 2\n", colours=RED), "expected red from 0 to 255"),
        (ply(body=POINTS + "3 0 1 4e9\n"), "expected vertex_indices from -2147483648 to 2147483647, found 4e+09"),
        (ply(body=POINTS + "3 0 1 1.5\n"), "found 1.5"),
        (ply(body=POINTS + "3 0 1 nan\n"), "found nan"),
        (binary("property list uint int vertex_indices\n", struct.pack("<I3i", 2**32 - 1, 0, 1, 2)), "cut off"),
        (binary("property list int int vertex_indices\n", struct.pack("<i3i", -3, 0, 1, 2)), "cut off"),
        (ply("", "").replace(b"face 1", b"face 0").replace(b"vertex 3", b"vertex 0"), "empty mesh"),
    ],
)
def test_a_ply_that_lies_is_one_line(data: bytes, said: str, tmp_path: Path):
    path = tmp_path / "x.ply"
    path.write_bytes(data)
    with pytest.raises(InputError, match=re.escape(said)) as caught:
        read_mesh(path)
    assert caught.value.where == str(path)


def test_a_ply_may_hold_more_than_a_mesh(tmp_path: Path):
    path = tmp_path / "x.ply"
    more = "element camera 1\nproperty float f\n"
    binary = ply(before=more).replace(b"ascii", b"binary_little_endian").partition(b"0 0 0")[0]
    for data in (
        ply(),
        ply(before=more, body="7\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"),
        binary + struct.pack("<f", 7) + BINARY + struct.pack("<B3i", 3, 0, 1, 2),
    ):
        path.write_bytes(data)
        found = read_mesh(path)
        assert (found.mesh.faces.tolist(), found.colours) == ([[0, 1, 2]], None)


def test_a_texture_lies_beside_its_mesh(tmp_path: Path):
    from PIL import Image

    (tmp_path / "inner" / "skins").mkdir(parents=True)
    for place in (tmp_path / "t.png", tmp_path / "inner" / "skins" / "t.png"):
        Image.new("RGB", (4, 4), (9, 8, 7)).save(place)
    (tmp_path / "inner" / "e.png").write_text("%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\nshowpage\n")
    path, materials = tmp_path / "inner" / "x.obj", tmp_path / "inner" / "x.mtl"
    path.write_text("mtllib x.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n")
    materials.write_text("newmtl a\nmap_Kd skins/t.png\n")
    assert read_coloured_mesh(path).colours is not None
    for name, said in (
        ("../t.png", "x.obj: expected the texture beside it or in a folder below, found '../t.png'"),
        (str(tmp_path / "t.png"), "expected the texture beside it"),
        ("e.png", "e.png: not a readable image"),
        ("none.png", "none.png: no such file, the texture of x.obj"),
    ):
        materials.write_text(f"newmtl a\nmap_Kd {name}\n")
        with pytest.raises(InputError, match=re.escape(said)):
            read_coloured_mesh(path)
