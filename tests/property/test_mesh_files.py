"""What is written is read back, whatever the mesh."""

import io
import tempfile
from pathlib import Path

import numpy as np
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from capture4d.errors import InputError
from capture4d.geometry.mesh import boundary_edges, boundary_loops, unique_edges
from capture4d.mesh_files.meshes import read_coloured_mesh, read_mesh, write_mesh
from capture4d.types import Mesh

FLOATS = st.floats(-1e6, 1e6, width=32, allow_subnormal=False)
Drawn = tuple[tuple[np.ndarray, np.ndarray, np.ndarray], np.ndarray, np.ndarray]


@st.composite
def drawings(draw: st.DrawFn) -> Drawn:
    """Any polygons on any vertices, with UVs; colours; and the polygons' sizes."""
    count = draw(st.integers(1, 12))
    vertices = draw(hnp.arrays(np.float32, (count, 3), elements=FLOATS))
    colours = draw(hnp.arrays(np.uint8, (count, 3)))
    sizes = draw(hnp.arrays(np.int32, st.integers(1, 6), elements=st.integers(3, 7)))
    faces, uv = [], []
    for size in sizes:
        corners = draw(hnp.arrays(np.int32, int(size), elements=st.integers(0, count - 1)))
        texture = draw(hnp.arrays(np.float32, (int(size), 2), elements=FLOATS))
        fan = np.array([[0, k + 1, k + 2] for k in range(size - 2)])
        faces.append(corners[fan])
        uv.append(texture[fan])
    return (vertices, np.concatenate(faces), np.concatenate(uv)), colours, sizes


@given(drawings(), st.sampled_from([".obj", ".ply"]))
@settings(max_examples=60, deadline=None)
def test_files_return_what_they_were_given(drawn: Drawn, suffix: str):
    arrays, colours, sizes = drawn
    mesh = Mesh(*arrays)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"mesh{suffix}"
        write_mesh(path, mesh, colours=colours, polygon_sizes=sizes)
        found = read_mesh(path)
    np.testing.assert_array_equal(found.mesh.vertices, mesh.vertices)
    np.testing.assert_array_equal(found.mesh.faces, mesh.faces)
    np.testing.assert_array_equal(found.mesh.uv, mesh.uv)
    found_sizes = np.full(len(mesh.faces), 3) if found.polygon_sizes is None else found.polygon_sizes
    np.testing.assert_array_equal(found_sizes, sizes)
    np.testing.assert_array_equal(found.colours, colours)


@given(drawings())
@settings(max_examples=20, deadline=None)
def test_glb_keeps_the_numbering(drawn: Drawn):
    arrays, colours, _ = drawn
    mesh = Mesh(*arrays)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.glb"
        write_mesh(path, mesh, colours=colours)
        found = read_mesh(path)
    np.testing.assert_array_equal(found.mesh.vertices, mesh.vertices)
    np.testing.assert_array_equal(found.mesh.faces, mesh.faces)
    np.testing.assert_array_equal(found.colours, colours)


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_loops_are_the_border_of_any_part_of_a_sheet(data: st.DataObject):
    """On a consistently wound mesh, every border edge is in exactly one loop, and no loop repeats a vertex."""
    side = 5
    corner = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).reshape(-1)
    sheet = np.concatenate(
        [
            np.stack([corner, corner + 1, corner + side + 2], 1),
            np.stack([corner, corner + side + 2, corner + side + 1], 1),
        ]
    ).astype(np.int32)
    faces = sheet[data.draw(hnp.arrays(bool, len(sheet)))]
    edges = sorted(map(tuple, boundary_edges(faces).tolist()))
    loops = boundary_loops(faces)
    walked = sorted(pair for loop in loops for pair in zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True))
    assert walked == edges
    assert all(len(set(loop.tolist())) == len(loop) for loop in loops)
    assert len(edges) == 2 * len(unique_edges(faces)) - 3 * len(faces)


def _sample_files() -> dict[str, bytes]:
    rng = np.random.default_rng(0)
    vertices = rng.random((6, 3), np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3], [1, 4, 5]], np.int32)
    mesh = Mesh(vertices, faces, np.random.default_rng(1).random((3, 3, 2), np.float32))
    files = {}
    with tempfile.TemporaryDirectory() as folder:
        for suffix in (".obj", ".ply", ".glb"):
            path = Path(folder) / f"mesh{suffix}"
            write_mesh(path, mesh, colours=np.full((6, 3), 7, np.uint8), polygon_sizes=np.array([4, 3], np.int32))
            files[path.name] = path.read_bytes()
        model = trimesh.Trimesh(vertices, faces, process=False)
        model.visual = trimesh.visual.TextureVisuals(
            rng.random((6, 2)), material=trimesh.visual.material.PBRMaterial(baseColorTexture=PICTURE)
        )
        files["textured.glb"] = trimesh.Scene(model).export(file_type="glb")
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    files["text.ply"] = f"{head}element face 1\nproperty list char int vertex_indices\nend_header\n".encode() + (
        b"0 0 0\n1 0 0\n1 1 0\n3 0 1 2\n"
    )
    model = trimesh.Trimesh(vertices, faces, process=False)
    for name, kind in (("text.stl", "stl_ascii"), ("binary.stl", "stl")):
        data = model.export(file_type=kind)
        files[name] = data if isinstance(data, bytes) else str(data).encode()
    files["colours.off"] = b"COFF\n3 1 0\n0 0 0 1 2 3\n1 0 0 4 5 6\n1 1 0 7 8 9 # last\n3 0 1 2 0.5 0.5 0.5\n"
    files["odd.obj"] = (
        b"mtllib x.mtl\n" + b"v 0 0 0 1 0 0\nv 1 0 0 .5 nan 0\n v 1 1 0 1 \\\n 1 1 # last\nvt nan 0\nf 1/1 -2// 3\n"
    )
    return files


PICTURE = Image.fromarray(np.random.default_rng(2).integers(0, 256, (4, 4, 3), np.uint8))
SAMPLES = _sample_files()
SPLICE = st.tuples(st.floats(0, 1), st.integers(0, 6), st.binary(max_size=4))


@given(st.sampled_from(sorted(SAMPLES)), st.lists(SPLICE, min_size=1, max_size=3))
@settings(max_examples=400, deadline=None)
def test_a_damaged_file_is_a_mesh_or_one_line(name: str, splices: list[tuple[float, int, bytes]]):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_bytes(spliced(SAMPLES[name], splices))
        said = ""
        try:
            read_coloured_mesh(path)
        except InputError as error:
            said = str(error)
    assert not said or said.startswith(str(path))
    assert "\n" not in said


def spliced(data: bytes, splices: list[tuple[float, int, bytes]]) -> bytes:
    for place, removed, inserted in splices:
        start = int(place * len(data))
        data = data[:start] + inserted + data[start + removed :]
    return data


def _textured_obj() -> dict[str, bytes]:
    pictures = {}
    for kind in ("png", "jpeg", "tiff"):
        stream = io.BytesIO()
        PICTURE.save(stream, kind)
        pictures[f"skin.{kind}"] = stream.getvalue()
    return pictures | {"mesh.mtl": b"newmtl skin\nmap_Kd skin.png\n"}


COMPANIONS = _textured_obj()


@given(st.sampled_from(sorted(COMPANIONS)), st.lists(SPLICE, min_size=1, max_size=3))
@settings(max_examples=200, deadline=None)
def test_a_damaged_texture_is_a_picture_or_one_line(name: str, splices: list[tuple[float, int, bytes]]):
    picture = "skin.png" if name.endswith("mtl") else name
    files = COMPANIONS | {"mesh.mtl": f"newmtl skin\nmap_Kd {picture}\n".encode()}
    files[name] = spliced(files[name], splices)
    with tempfile.TemporaryDirectory() as folder:
        for file, data in files.items():
            (Path(folder) / file).write_bytes(data)
        path = Path(folder) / "mesh.obj"
        path.write_text("mtllib mesh.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n")
        said = ""
        try:
            read_coloured_mesh(path)
        except InputError as error:
            said = str(error)
    assert not said or said.startswith(folder)
    assert "\n" not in said
