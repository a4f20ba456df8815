"""Files of moving meshes, held against what their formats say, byte by byte or by the formats' own libraries."""

import importlib.util
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture4d.errors import InputError
from capture4d.mesh_files.animated.alembic import read_alembic, write_alembic
from capture4d.mesh_files.animated.moving_mesh import MovingMesh, largest_difference
from capture4d.mesh_files.animated.point_caches import read_mdd, read_pc2, write_mdd, write_pc2
from capture4d.mesh_files.animated.usd import read_usd, usd_faults, write_usd
from capture4d.types import Mesh
from tests.moving_garment import cloth

needs_usd = pytest.mark.skipif(
    not importlib.util.find_spec("pxr"), reason="usd-core is not installed: USD is not tried"
)
needs_alembic = pytest.mark.skipif(
    not importlib.util.find_spec("alembic3d"), reason="alembic3d is not installed: Alembic is not tried"
)


def moving(frames: int = 4, *, first: int = 4801, step: int = 1, fps: float = 59.94, mesh: Mesh | None = None):
    mesh = mesh or cloth()
    rng = np.random.default_rng(frames + first)
    vertices = (mesh.vertices + 0.05 * rng.standard_normal((frames, 1, 3))).astype(np.float32)
    vertices += 0.001 * rng.standard_normal(vertices.shape).astype(np.float32)
    ids = (first + step * np.arange(frames)).astype(np.int32)
    return MovingMesh(mesh.with_vertices(vertices[0]), ids, fps, lambda: iter(vertices))


# --- point caches ------------------------------------------------------------------------------------------------


def test_a_pc2_is_what_the_format_says_and_comes_back(tmp_path: Path):
    written = moving(step=2)
    write_pc2(tmp_path / "a.pc2", written)
    data = (tmp_path / "a.pc2").read_bytes()
    assert struct.unpack("<12siiffi", data[:32]) == (b"POINTCACHE2\0", 1, 336, 4801.0, 2.0, 4)
    assert np.array_equal(np.frombuffer(data[32:], "<f4").reshape(4, -1, 3), list(written.frames()))
    assert largest_difference(written, read_pc2(tmp_path / "a.pc2", written.mesh)) == 0


def test_an_mdd_is_what_the_format_says_and_comes_back(tmp_path: Path):
    written = moving(first=7, fps=24.0)
    write_mdd(tmp_path / "a.mdd", written)
    data = (tmp_path / "a.mdd").read_bytes()
    assert struct.unpack(">2i", data[:8]) == (4, 336)
    assert np.allclose(np.frombuffer(data[8:24], ">f4"), np.arange(7, 11) / 24)
    assert np.array_equal(np.frombuffer(data[24:], ">f4").reshape(4, -1, 3), list(written.frames()))
    assert largest_difference(written, read_mdd(tmp_path / "a.mdd", written.mesh, 24.0)) == 0


def test_a_cache_of_another_mesh_or_cut_off_is_one_line(tmp_path: Path):
    write_pc2(tmp_path / "a.pc2", moving())
    with pytest.raises(InputError, match=r"a\.pc2: expected the 3 vertices of the mesh, found 336"):
        read_pc2(tmp_path / "a.pc2", Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32)))
    (tmp_path / "a.pc2").write_bytes((tmp_path / "a.pc2").read_bytes()[:-4])
    with pytest.raises(InputError, match="expected 16160 bytes for 4 frames, found 16156"):
        read_pc2(tmp_path / "a.pc2", cloth())
    with pytest.raises(InputError, match="begins with POINTCACHE2"):
        read_pc2(Path(__file__), cloth())


def test_a_cache_cannot_hold_frames_with_gaps(tmp_path: Path):
    odd = replace(moving(3), frame_ids=np.array([1, 2, 5], np.int32))
    with pytest.raises(InputError, match=r"pc2: expected frames 1 apart, .* found frame 5 after frame 2"):
        write_pc2(tmp_path / "a.pc2", odd)
    assert not list(tmp_path.iterdir())


# --- USD and Alembic ---------------------------------------------------------------------------------------------


@needs_usd
@pytest.mark.parametrize("ids", [[4801, 4802, 4803], [1, 4, 9]])
def test_usd_keeps_positions_times_and_normals(ids: list[int], tmp_path: Path):
    from pxr import Usd, UsdGeom

    written = replace(moving(3), frame_ids=np.array(ids, np.int32))
    write_usd(tmp_path / "a.usdc", written)
    assert usd_faults(tmp_path / "a.usdc") == []
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    assert (stage.GetTimeCodesPerSecond(), stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (59.94, ids[0], ids[-1])
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/garment/mesh"))
    assert mesh.GetPointsAttr().GetTimeSamples() == ids
    corners = np.array(list(written.frames())[1], np.float64)[written.mesh.faces]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    wanted = np.zeros((len(written.mesh.vertices), 3))
    np.add.at(wanted, written.mesh.faces, flat[:, None])
    wanted /= np.linalg.norm(wanted, axis=1, keepdims=True)
    assert np.allclose(mesh.GetNormalsAttr().Get(ids[1]), wanted, atol=1e-5)
    assert largest_difference(written, read_usd(tmp_path / "a.usdc")) == 0


@needs_usd
def test_usd_of_another_maker_comes_in_metres_y_up_and_wound_outwards(tmp_path: Path):
    """Centimetres, Z up, wound clockwise, moved by its parent, a UV at each vertex, a square instead of triangles."""
    from pxr import Gf, Sdf, Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    stage.SetTimeCodesPerSecond(30)
    UsdGeom.Xform.Define(stage, "/there").AddTranslateOp().Set(Gf.Vec3d(0, 0, 100))
    mesh = UsdGeom.Mesh.Define(stage, "/there/mesh")
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([3, 2, 1, 0])
    mesh.CreateOrientationAttr("leftHanded")
    square = [(0, 0, 0), (100, 0, 0), (100, 100, 0), (0, 100, 0)]
    for frame in (10, 11):
        mesh.CreatePointsAttr().Set([Gf.Vec3f(x, y, z + frame) for x, y, z in square], frame)
    kind = Sdf.ValueTypeNames.TexCoord2fArray
    UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", kind, UsdGeom.Tokens.vertex).Set([(0, 0), (1, 0), (1, 1), (0, 1)])
    stage.GetRootLayer().Save()

    found = read_usd(tmp_path / "a.usda")
    assert (found.fps, found.frame_ids.tolist()) == (30, [10, 11])
    up = [1.1, 1.11]
    assert np.allclose(list(found.frames()), [[(0, y, 0), (1, y, 0), (1, y, -1), (0, y, -1)] for y in up])
    assert found.mesh.uv is not None
    assert np.allclose(found.mesh.uv, np.array([(0, 0), (1, 0), (1, 1), (0, 1)])[found.mesh.faces])
    a, b, c = found.mesh.vertices[found.mesh.faces[0]]
    assert np.cross(b - a, c - a)[1] > 0


@needs_alembic
@pytest.mark.parametrize("ids", [[4801, 4802, 4803], [1, 4, 9]])
def test_alembic_keeps_positions_times_uvs_and_normals(ids: list[int], tmp_path: Path):
    written = replace(moving(3), frame_ids=np.array(ids, np.int32))
    write_alembic(tmp_path / "a.abc", written)
    found = read_alembic(tmp_path / "a.abc", 59.94)
    assert largest_difference(written, found) == 0
    assert found.normals is not None
    assert np.allclose([np.linalg.norm(each, axis=1) for each in found.normals()], 1, atol=1e-5)


@needs_alembic
def test_alembic_without_uvs_and_with_a_rate_of_its_own(tmp_path: Path):
    bare = Mesh(cloth().vertices, cloth().faces)
    written = moving(3, mesh=bare, first=1, fps=24.0)
    write_alembic(tmp_path / "a.abc", written, normals=False)
    found = read_alembic(tmp_path / "a.abc")
    assert (found.mesh.uv, found.normals) == (None, None)
    assert largest_difference(written, found) == 0


@needs_usd
@needs_alembic
@pytest.mark.parametrize(("name", "read"), [("a.usdc", read_usd), ("a.abc", read_alembic)])
def test_a_file_of_something_else_is_one_line(name: str, read, tmp_path: Path):
    (tmp_path / name).write_bytes(b"PXR-USDC" + b"\0" * 40)
    with pytest.raises(InputError, match=f"{name}: "):
        read(tmp_path / name)


@needs_usd
def test_what_was_written_is_held_against_what_is_read(tmp_path: Path):
    """One vertex of one frame, half a millimetre aside."""
    written = moving()
    write_usd(tmp_path / "a.usdc", written)
    frames = [each.copy() for each in written.frames()]
    frames[2][17, 1] += 0.0005
    assert largest_difference(replace(written, frames=lambda: iter(frames)), read_usd(tmp_path / "a.usdc")) == (
        pytest.approx(0.0005, rel=1e-3)
    )
