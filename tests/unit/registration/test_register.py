"""One frame: exact where it can be, equivariant, better with better scans."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from capture4d.errors import InputError
from capture4d.geometry.mesh import unique_edges
from capture4d.types import Garment, GarmentScan, Mesh
from registration.config import PAPER, GraphConfig, LinearSolverConfig, RegistrationConfig
from registration.register import prepare_frame, register_frame
from registration.template import UnknownBorderError, analyse_template


def bend(points: np.ndarray) -> np.ndarray:
    """Lean the tube over, more towards the top, and shift it."""
    angle = 0.4 * points[:, 1]
    x, y = points[:, 0], points[:, 1]
    return np.column_stack([x * np.cos(angle) + 0.12 * y**2, y - x * np.sin(angle), points[:, 2] + 0.01])


def fit(garment, scan, start, config, schedule="cold"):
    analysis = analyse_template(garment, config)
    return register_frame(analysis, prepare_frame(analysis, scan, config), start, config=config, schedule=schedule)


def subdivide(mesh: Mesh) -> Mesh:
    """Every face in four: the same surface."""
    edges = unique_edges(mesh.faces)
    number = {tuple(edge): len(mesh.vertices) + k for k, edge in enumerate(edges.tolist())}
    middle = mesh.vertices[edges].mean(axis=1)
    faces = []
    for a, b, c in mesh.faces.tolist():
        ab, bc, ca = (number[min(pair), max(pair)] for pair in ((a, b), (b, c), (c, a)))
        faces += [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return Mesh(np.concatenate([mesh.vertices, middle]).astype(np.float32), np.array(faces, np.int32))


def test_a_rigid_motion_is_recovered(garment, exact) -> None:
    rotation = Rotation.from_euler("xyz", [4, 3, -3], degrees=True)

    def move(points: np.ndarray) -> np.ndarray:
        return rotation.apply(points.astype(float)) + np.array([0.01, -0.015, 0.008])

    fine = subdivide(subdivide(garment.template))
    loops = list(garment.loops.values())
    scan = GarmentScan(
        fine.with_vertices(move(fine.vertices).astype(np.float32)),
        move(garment.template.vertices[np.concatenate(loops)]).astype(np.float32),
        np.repeat(np.array([0, 1], np.int32), [len(loop) for loop in loops]),
        tuple(garment.loops),
        7,
    )
    result = fit(garment, scan, garment.template.vertices, exact)
    assert np.linalg.norm(result.vertices - move(garment.template.vertices), axis=1).max() < 5e-5


def test_bending_is_followed_with_the_right_material(garment, scan_of, config) -> None:
    start = garment.template.vertices.astype(float)
    truth = bend(start)
    result = fit(garment, scan_of(bend), start, config)
    assert np.linalg.norm(start - truth, axis=1).mean() > 0.015
    assert np.linalg.norm(result.vertices - truth, axis=1).mean() < 0.005


def test_equivariance_under_rigid_motions(garment, scan_of, config) -> None:
    """Moving template and scan together moves the result."""
    motion = Rotation.from_euler("xyz", [40, -70, 110], degrees=True)
    jitter = 0.002 * np.random.default_rng(5).standard_normal(garment.template.vertices.shape)  # no ties to break
    start = garment.template.vertices.astype(float) + jitter
    garment = Garment(garment.template.with_vertices(start.astype(np.float32)), garment.loops)

    def moved(points: np.ndarray) -> np.ndarray:
        return motion.apply(points) + np.array([0.1, -0.2, 0.3])

    config = replace(config, solver=LinearSolverConfig(tolerance=1e-8, max_iterations=2000))
    plain = fit(garment, scan_of(bend, noise=5e-4), start, config).vertices
    turned_garment = Garment(garment.template.with_vertices(moved(start).astype(np.float32)), garment.loops)
    straight = scan_of(bend, noise=5e-4)
    turned_scan = replace(
        straight,
        mesh=straight.mesh.with_vertices(moved(straight.mesh.vertices).astype(np.float32)),
        boundary_points=moved(straight.boundary_points).astype(np.float32),
    )
    turned = fit(turned_garment, turned_scan, moved(start), config).vertices
    assert np.linalg.norm(turned - moved(plain), axis=1).mean() < 5e-4


def test_error_falls_with_the_resolution_of_the_scan(garment, scan_of, config) -> None:
    start = garment.template.vertices.astype(float)
    fine = scan_of(bend, around=600, along=300).mesh.vertices
    errors = []
    for around in (40, 80, 160):
        result = fit(garment, scan_of(bend, around=around, along=around // 2), start, config)
        errors.append(KDTree(fine).query(result.vertices)[0].mean())
    assert errors[2] < errors[1] < errors[0]


def test_borders_are_found_only_when_asked_for(garment, scan_of, config) -> None:
    """A longer scan: without painted points nothing tells the template where its borders belong."""

    def lengthen(points: np.ndarray) -> np.ndarray:
        return points * [1.0, 1.05, 1.0]

    scan = scan_of(lengthen)
    bare = GarmentScan(scan.mesh, scan.boundary_points[:0], scan.boundary_loops[:0], scan.loop_names, scan.frame_id)
    start = garment.template.vertices.astype(float)
    neck = garment.loops["neck"]
    with_paint, without = (fit(garment, s, start, config).vertices[neck, 1].mean() for s in (scan, bare))
    assert abs(with_paint - 0.525) < 0.004
    assert abs(without - 0.525) > 0.01


def test_the_start_must_be_within_reach(garment, scan_of, config) -> None:
    far = scan_of(lambda p: p + np.array([5.0, 0, 0]))
    with pytest.raises(InputError, match="frame 7: expected scan vertices within"):
        fit(garment, far, garment.template.vertices.astype(float), config)


def test_an_empty_scan_is_refused(garment, config) -> None:
    nothing = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    scan = GarmentScan(nothing, np.zeros((0, 3), np.float32), np.zeros(0, np.int32), (), 7)
    with pytest.raises(InputError, match="frame 7: expected a garment scan with faces"):
        prepare_frame(analyse_template(garment, config), scan, config)


def test_repeating_gives_the_same_bits(garment, scan_of, config) -> None:
    scan, start = scan_of(bend, noise=3e-4), garment.template.vertices.astype(float)
    first, second = (fit(garment, scan, start, config).vertices for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_paints_named_after_loops_that_the_template_lacks_are_refused(garment, scan_of, config) -> None:
    scan = replace(scan_of(bend), loop_names=("waist", "neck"))
    analysis = analyse_template(garment, config)
    with pytest.raises(UnknownBorderError, match=r"expected border loops named waist.*found those named hem, neck"):
        prepare_frame(analysis, scan, config)
    shared = replace(scan, boundary_loops=np.full_like(scan.boundary_loops, -1))
    assert len(prepare_frame(analysis, shared, config).border_points), "a shared paint names no loop"


def test_the_warm_schedule_follows_a_small_motion_and_keeps_its_lengths(garment, scan_of, config) -> None:
    start = garment.template.vertices.astype(float)

    def lean(points: np.ndarray) -> np.ndarray:
        return points + np.column_stack([0.02 * points[:, 1] ** 2, 0 * points[:, 0], 0.004 + 0 * points[:, 0]])

    cold, warm = (fit(garment, scan_of(lean), start, config, schedule) for schedule in ("cold", "warm"))
    assert warm.schedule == "warm"
    assert warm.linear_iterations < cold.linear_iterations
    assert np.linalg.norm(warm.vertices - lean(start), axis=1).mean() < 0.002
    edges = unique_edges(garment.template.faces)
    lengths = [np.linalg.norm(v[edges[:, 0]] - v[edges[:, 1]], axis=1) for v in (warm.vertices, lean(start))]
    assert np.abs(lengths[0] / lengths[1] - 1).mean() < 0.02


def test_the_method_as_printed_moves_the_template_onto_the_scan(garment, scan_of) -> None:
    config = replace(PAPER, graph=GraphConfig(nodes=40, vertices=0))
    start = garment.template.vertices.astype(float)
    truth = bend(start)
    result = fit(garment, scan_of(bend), start, config)
    before, after = (np.linalg.norm(points - truth, axis=1).mean() for points in (start, result.vertices))
    assert after < 0.6 * before


def test_the_cold_graph_stage_has_its_own_compression(garment, scan_of, config) -> None:
    """Of what the dense stage does with compression the graph knows nothing."""
    graph_only = replace(config, dense=replace(config.dense, cold=replace(config.dense.cold, steps=0)))
    start, scan = garment.template.vertices.astype(float), scan_of(lambda points: points * [1.0, 0.9, 1.0])

    def found(changed: RegistrationConfig) -> np.ndarray:
        return fit(garment, scan, start, changed).vertices

    usual = found(graph_only)
    loose = replace(graph_only, dense=replace(graph_only.dense, compression=0.0))
    np.testing.assert_array_equal(found(loose), usual)
    free = found(replace(graph_only, coarse=replace(graph_only.coarse, cold_compression=0.0)))
    assert np.ptp(free[:, 1]) < np.ptp(usual[:, 1])
