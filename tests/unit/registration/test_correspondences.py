"""Scan preparation against slow, obvious references; gates and layers of the match."""

from collections.abc import Callable

import numpy as np
import pytest

from capture4d.geometry.mesh import boundary_edges, connected_components, vertex_normals
from capture4d.geometry.mesh_kernels import face_components, laplacian_pass, open_vertices
from capture4d.types import Mesh
from registration.correspondences import Gates, match, match_both_ways, mesh_normals, of_another_part, prepare_scan


@pytest.fixture
def rough(tube: Callable[[int, int], Mesh]) -> Mesh:
    """A tube with holes and noise."""
    mesh, rng = tube(40, 20), np.random.default_rng(0)
    faces = mesh.faces[rng.random(len(mesh.faces)) > 0.05]
    noise = 0.002 * rng.standard_normal(mesh.vertices.shape)
    return Mesh((mesh.vertices + noise).astype(np.float32), faces)


def test_open_vertices_are_those_of_the_boundary_edges(rough: Mesh) -> None:
    is_open, used = open_vertices(rough.faces, len(rough.vertices))
    expected = np.zeros(len(rough.vertices), bool)
    expected[boundary_edges(rough.faces)] = True
    np.testing.assert_array_equal(is_open, expected)
    np.testing.assert_array_equal(np.flatnonzero(used), np.unique(rough.faces))


def test_normals_are_those_of_the_foundation(rough: Mesh) -> None:
    vertices = rough.vertices.astype(float)
    np.testing.assert_allclose(mesh_normals(vertices, rough.faces), vertex_normals(vertices, rough.faces), atol=1e-12)


def test_laplacian_pass_moves_half_way_to_the_neighbours(rough: Mesh) -> None:
    vertices = rough.vertices.astype(float)
    fixed, _ = open_vertices(rough.faces, len(vertices))
    result = laplacian_pass(vertices, rough.faces, fixed)
    for vertex in range(0, len(vertices), 37):
        around = rough.faces[(rough.faces == vertex).any(axis=1)]
        neighbours = around[around != vertex]
        if fixed[vertex] or not len(neighbours):
            np.testing.assert_array_equal(result[vertex], vertices[vertex])
        else:
            expected = 0.5 * (vertices[vertex] + vertices[neighbours].mean(axis=0))
            np.testing.assert_allclose(result[vertex], expected, atol=1e-12)


def test_face_components_agree_with_the_foundation(rough: Mesh) -> None:
    active = rough.vertices[rough.faces, 1].mean(axis=1) % 0.1 > 0.03
    parts = face_components(rough.faces, len(rough.vertices), active)
    labels = connected_components(rough.faces[active], len(rough.vertices))[rough.faces[active][:, 0]]
    assert (parts[~active] == -1).all()
    assert len(np.unique(parts[active])) == len(np.unique(labels)) == len(set(zip(parts[active], labels, strict=True)))


def test_smoothing_brings_noise_nearer_to_the_surface(tube: Callable[[int, int], Mesh]) -> None:
    mesh, rng = tube(160, 80), np.random.default_rng(1)
    noisy = mesh.vertices + 0.0005 * rng.standard_normal(mesh.vertices.shape)
    radius = [np.linalg.norm(p - mesh.vertices, axis=1).mean() for p in (
        prepare_scan(noisy, mesh.faces, smoothing_passes=n).points for n in (0, 1))]  # fmt: skip
    assert radius[1] < 0.8 * radius[0]


def test_smoothing_need_not_shrink_what_is_round(tube: Callable[[int, int], Mesh]) -> None:
    mesh = tube(16, 30)
    inner = slice(16 * 3, -16 * 3)
    width = {}
    for unshrunk in (False, True):
        points = prepare_scan(mesh.vertices, mesh.faces, smoothing_passes=1, unshrunk=unshrunk).points
        width[unshrunk] = np.linalg.norm(points[inner][:, [0, 2]], axis=1).mean()
    whole = np.linalg.norm(mesh.vertices[inner][:, [0, 2]], axis=1).mean()
    assert abs(width[True] - whole) < 0.2 * (whole - width[False])
    noisy = mesh.vertices + 0.002 * np.random.default_rng(3).standard_normal(mesh.vertices.shape)
    calmer = prepare_scan(noisy, mesh.faces, smoothing_passes=1, unshrunk=True).points
    rough, left = (np.linalg.norm(points[inner] - mesh.vertices[inner], axis=1).mean() for points in (noisy, calmer))
    assert left < 0.85 * rough


def test_gates() -> None:
    plane = Mesh(
        np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], np.float32), np.array([[0, 1, 2], [1, 3, 2]], np.int32)
    )
    surface = prepare_scan(plane.vertices, plane.faces, smoothing_passes=0)
    points = np.array([[0, 0, 0.01], [0, 0, 0.01], [0, 0, 0.5]])
    normals = np.array([[0, 0, 1.0], [0, 0, -1.0], [0, 0, 1.0]])
    found = match(surface, points, normals, Gates(0.1, normal_cosine=0.4, robust_scale=0.5))
    assert found.weights[0] == pytest.approx((1 + (0.01 / 0.05) ** 2) ** -2)
    np.testing.assert_array_equal(found.weights[1:], 0)


def test_the_layer_that_looks_the_right_way_is_matched(tube: Callable[[int, int], Mesh]) -> None:
    """Two sheets back to back, 2 mm apart: points on either find their own, whichever is nearer."""
    mesh = tube(60, 30)
    outward = vertex_normals(mesh.vertices, mesh.faces)
    inner = mesh.vertices - 0.002 * outward
    count = len(mesh.vertices)
    faces = np.concatenate([mesh.faces, mesh.faces[:, ::-1] + count]).astype(np.int32)
    surface = prepare_scan(np.concatenate([mesh.vertices, inner]), faces, smoothing_passes=0)
    points = (mesh.vertices - 0.0015 * outward).astype(float)
    found = match(surface, points, outward.astype(float), Gates(0.05, normal_cosine=0.4, robust_scale=1.0))
    assert (found.weights > 0).all()
    assert (np.einsum("va,va->v", found.normals, outward) > 0).all()


def test_on_a_round_surface_the_mean_normal_leaves_nothing_to_pull_at(tube: Callable[[int, int], Mesh]) -> None:
    """Two points of one circle lie in a plane that the mean of their normals is upright on; of the scan's own plane
    the other point is off, which holds a turning limb back."""
    mesh = tube(24, 12)
    vertices = mesh.vertices.astype(float)
    ring = 2 * np.pi * np.arange(len(vertices)) / 24
    vertices[:, 0], vertices[:, 2] = 0.2 * np.sin(ring), 0.2 * np.cos(ring)
    surface = prepare_scan(vertices, mesh.faces, smoothing_passes=0)
    angle = 0.4 * 2 * np.pi / 24  # short of half way to the next scan point
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    inner = slice(24, -24)  # the normals of the outer rings lean to the side with more faces
    points, normals = vertices[inner] @ turn.T, surface.normals[inner] @ turn.T
    gates = Gates(0.05, normal_cosine=0.4, robust_scale=1.0)
    off = {}
    for of_both in (False, True):
        found = match(surface, points, normals, gates, of_both=of_both)
        np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1.0, atol=1e-9)
        off[of_both] = np.abs(np.einsum("va,va->v", points - found.points, found.normals)).max()
    assert off[True] < 0.02 * off[False]


def test_scan_beyond_the_edge_pulls_only_if_it_has_a_vote(tube: Callable[[int, int], Mesh]) -> None:
    template, scan = tube(24, 12), tube(80, 40)
    low = template.vertices.astype(float) * [1, 0.8, 1]
    surface = prepare_scan(scan.vertices, scan.faces, smoothing_passes=0)
    normals = mesh_normals(low, template.faces)
    top = low[:, 1] > 0.39
    gates = Gates(0.3, normal_cosine=0.0, robust_scale=1.0)
    one_way = match(surface, low, normals, gates)
    both = match_both_ways(surface, low, normals, gates, neighbours=3, max_points=5000, normal_length=0.05)
    assert (one_way.points - low)[top, 1].mean() < 0.01
    assert (both.points - low)[top, 1].mean() > 0.02


def test_scan_of_another_part_is_told_from_a_vertex_s_own() -> None:
    """Two sheets of one template, 3 cm apart, whose scan shows the front one alone."""
    grid = np.stack(np.meshgrid(np.arange(10), np.arange(10)), axis=-1).reshape(-1, 2) * 0.01
    front, back = (np.column_stack([grid, np.full(len(grid), z)]) for z in (0.0, -0.03))
    vertices = np.concatenate([front, back])
    rest = np.concatenate([front, back + np.array([0.5, 0, 0])])
    targets = np.concatenate([front, front]) + np.array([0.0, 0.0, 0.001])
    distances = np.linalg.norm(vertices - targets, axis=1)
    own = np.arange(len(vertices))
    foreign = of_another_part(targets, distances, own, vertices, rest, share=0.5, reach=0.03)
    np.testing.assert_array_equal(foreign, own >= len(front))
    slow = [
        bool(any(
            np.linalg.norm(vertices[u] - targets[v]) < 0.5 * distances[v] and np.linalg.norm(rest[u] - rest[v]) > 0.03
            for u in [int(np.argmin(np.linalg.norm(vertices - targets[v], axis=1)))]
        ))
        for v in own
    ]  # fmt: skip
    np.testing.assert_array_equal(foreign, slow)
    assert not of_another_part(targets, distances, own, vertices, rest, share=0.5, reach=1.0).any(), "it is one part"
    near = np.where(own >= len(front), 0.0, distances)
    assert not of_another_part(targets, near, own, vertices, rest, share=0.5, reach=0.03).any(), "nobody asked"
