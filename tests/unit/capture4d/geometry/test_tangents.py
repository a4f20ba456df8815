"""Tangents follow u, frames are rotations, and a mesh cut along seams stays whole elsewhere."""

import numpy as np

from capture4d.geometry.mesh import vertex_normals
from capture4d.geometry.tangents import TangentLayout, corner_tangents, frames_at
from capture4d.geometry.uv_raster import rasterise_uv
from capture4d.types import Mesh


def sheet(count: int = 9) -> Mesh:
    """A wavy sheet over the unit square, u along x and v along y."""
    x, y = np.meshgrid(np.linspace(0, 1, count), np.linspace(0, 1, count))
    z = 0.1 * np.sin(4 * x) * np.cos(3 * y)
    index = np.arange(count * count).reshape(count, count)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3).astype(np.int32)
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(np.float32)
    return Mesh(vertices, faces, vertices[faces][..., :2].copy())


def test_tangents_of_a_flat_sheet_are_the_u_axis():
    mesh = sheet()
    flat = mesh.vertices * np.array([1, 1, 0], np.float32)
    np.testing.assert_allclose(corner_tangents(flat, mesh.faces, mesh.uv), np.broadcast_to([1, 0, 0, 1], (128, 3, 4)))


def test_mirrored_uvs_have_the_other_handedness():
    mesh = sheet()
    mirrored = mesh.uv * np.array([-1, 1], np.float32) + np.array([1, 0], np.float32)
    tangent = corner_tangents(mesh.vertices, mesh.faces, mirrored)
    np.testing.assert_array_equal(tangent[..., 3], -1)
    np.testing.assert_allclose(
        tangent[..., :3], -corner_tangents(mesh.vertices, mesh.faces, mesh.uv)[..., :3], atol=1e-6
    )


def test_tangents_are_unit_orthogonal_to_the_normals_and_shared_by_a_vertex():
    mesh = sheet()
    tangent = corner_tangents(mesh.vertices, mesh.faces, mesh.uv)[..., :3]
    normal = vertex_normals(mesh.vertices.astype(float), mesh.faces)[mesh.faces]
    np.testing.assert_allclose(np.linalg.norm(tangent, axis=-1), 1, atol=1e-6)
    np.testing.assert_allclose((tangent * normal).sum(-1), 0, atol=1e-6)
    for vertex in range(len(mesh.vertices)):
        assert np.ptp(tangent[mesh.faces == vertex], axis=0).max() < 1e-6


def test_frames_turn_with_the_mesh_and_are_orthonormal():
    mesh = sheet()
    raster, layout = rasterise_uv(mesh, 32), TangentLayout(mesh.faces, mesh.uv)
    turn = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))

    def frames_of(vertices: np.ndarray) -> np.ndarray:
        normals = vertex_normals(vertices, mesh.faces)
        tangents = layout.tangents(vertices, normals)
        return frames_at(layout, raster.faces, raster.barycentric, normals=normals, tangents=tangents)

    frames, turned = frames_of(mesh.vertices.astype(float)), frames_of(mesh.vertices.astype(float) @ turn.T)
    np.testing.assert_allclose(turned, frames @ turn.T, atol=1e-6)
    np.testing.assert_allclose(frames @ frames.transpose(0, 2, 1), np.broadcast_to(np.eye(3), frames.shape), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(frames), 1, atol=1e-9)


def test_islands_are_told_by_their_seams():
    mesh = sheet()
    uv = mesh.uv.copy()
    right = mesh.uv[:, :, 0].mean(axis=1) > 0.5
    uv[right] += np.float32(2)
    islands = TangentLayout(mesh.faces, uv).islands()
    assert set(islands[right]).isdisjoint(islands[~right])
    assert len(set(islands)) == 2
    assert len(set(TangentLayout(mesh.faces, mesh.uv).islands())) == 1
