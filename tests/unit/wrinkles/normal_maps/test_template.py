"""Maps of a wrinkled tube whose normals are known in closed form."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.errors import InputError
from capture4d.geometry.mesh import submesh
from capture4d.types import Garment, Mesh
from tests.unit.wrinkles.conftest import from_tangent, wrinkle_normals
from wrinkles.normal_maps.config import MapConfig, ProjectionConfig
from wrinkles.normal_maps.scan_normals import project_scan
from wrinkles.normal_maps.spaces import garment_rotation, to_tangent
from wrinkles.normal_maps.template import MapTemplate, frame_pairs, temporal_window

SINGLE = ProjectionConfig(temporal_frames=1, smoothing_passes=0, blur_texels=0.0)
MAP = MapConfig(size=128)


def angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip((a * b).sum(axis=-1), -1, 1)))


def points_of(template: MapTemplate) -> np.ndarray:
    return template.raster.at_vertices(template.mesh.vertices.astype(float))


def test_low_normals_are_those_of_the_surface(garment: Garment):
    template = MapTemplate.create(garment, MAP)
    out = points_of(template) * np.array([1, 0, 1])
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    low = template.low_normals(garment.template.vertices)
    assert angle(low, out).max() < 2.5  # the triangles of the rims lean to one side
    assert angle(low, out).mean() < 0.5
    np.testing.assert_allclose(np.linalg.norm(low, axis=1), 1, atol=1e-6)


def test_both_sides_of_a_seam_show_the_same_low_normal(garment: Garment):
    """The template is closed at its seams: beside one, normals lean to neither side."""
    template = MapTemplate.create(garment, MAP)
    points = points_of(template)
    middle = np.abs(points[:, 1] - 0.25) < 0.2  # away from the rims
    seam = middle & (np.abs(points[:, 0]) < 6e-3)  # both seams lie at x = 0
    out = points * np.array([1, 0, 1])
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    islands = template.tangents.islands()[template.raster.faces]
    lean = template.low_normals(garment.template.vertices) - out
    for side in (points[:, 2] > 0, points[:, 2] < 0):
        for island in range(2):
            assert (seam & side & (islands == island)).sum() > 20
            assert np.abs(lean[seam & side & (islands == island)].mean(axis=0)).max() < 0.02


def test_the_scan_gives_the_wrinkles_back(garment: Garment, scan_of: Callable[..., Mesh]):
    template = MapTemplate.create(garment, MAP)
    low = template.low_normals(garment.template.vertices)
    found = project_scan(points_of(template), low, scan_of(), SINGLE)
    truth = wrinkle_normals(points_of(template))
    error = angle(found.normals, truth)[found.valid]
    assert angle(low, truth).mean() > 8
    assert error.mean() < 0.8
    assert found.valid[template.raster.inside].mean() > 0.96


def test_gates_refuse_what_is_too_far_or_turned(garment: Garment, scan_of: Callable[..., Mesh]):
    template = MapTemplate.create(garment, MAP)
    low, points = template.low_normals(garment.template.vertices), points_of(template)
    scan = scan_of()
    far = Mesh(scan.vertices * np.array([1.1, 1, 1.1], np.float32), scan.faces)
    assert not project_scan(points, low, far, SINGLE).valid.any()
    inside_out = Mesh(scan.vertices, scan.faces[:, ::-1].copy())
    assert not project_scan(points, low, inside_out, SINGLE).valid.any()
    with pytest.raises(InputError, match="faces"):
        project_scan(points, low, Mesh(scan.vertices, np.zeros((0, 3), np.int32)), SINGLE)


def test_the_nearest_point_answers_where_rays_miss_and_what_leans_too_far_does_not():
    """A square that ends beside the point, in the plane below it, or tilted about it."""
    row, column = np.mgrid[:9, :9]
    square = np.stack([column.ravel() - 8.0, row.ravel() - 4.0, np.zeros(81)], axis=1) * 5e-3  # ends at x = 0
    corner = (row * 9 + column)[:-1, :-1].ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + 1, corner + 10], 1), np.stack([corner, corner + 10, corner + 9], 1)]
    )
    up, config = np.array([[0.0, 0, 1]]), replace(SINGLE, border_rings=0)

    def seen(vertices: np.ndarray, x: float, **settings: float) -> bool:
        scan = Mesh(vertices.astype(np.float32), faces.astype(np.int32))
        return bool(project_scan(np.array([[x, 0, 0]]), up, scan, replace(config, **settings)).valid[0])

    assert seen(square - [0, 0, 2e-3], -0.01)  # above the square
    assert seen(square - [0, 0, 2e-3], 3e-3)  # beside it, 3.6 mm away
    assert not seen(square - [0, 0, 2e-3], 6e-3)  # 6.3 mm
    assert not seen(square - [0, 0, 7e-3], -0.01)
    for degrees, wanted in ((40, True), (50, False)):
        tilted = square @ Rotation.from_euler("y", degrees, degrees=True).as_matrix().T
        assert seen(tilted, -1e-4) == wanted
        assert seen(tilted, -1e-4, angle_deg=60.0)


def test_a_hole_is_no_information_and_its_rim_is_not_trusted(garment: Garment, scan_of: Callable[..., Mesh]):
    template = MapTemplate.create(garment, MAP)
    low, points = template.low_normals(garment.template.vertices), points_of(template)
    scan = scan_of()
    centre = np.array([0.1, 0.25, 0])
    kept = np.linalg.norm(scan.vertices[scan.faces].mean(axis=1) - centre, axis=1) > 0.04
    holed = submesh(scan, kept)[0]
    near = np.linalg.norm(points - centre, axis=1)
    valid = {rings: project_scan(points, low, holed, replace(SINGLE, border_rings=rings)).valid for rings in (0, 2)}
    for each in valid.values():
        assert not each[near < 0.03].any()
        assert each[(near > 0.06) & (np.abs(points[:, 1] - 0.25) < 0.1)].all()
    assert valid[2].sum() < valid[0].sum()


def test_neighbouring_frames_calm_the_noise_of_the_scanner(garment: Garment, scan_of: Callable[..., Mesh]):
    template = MapTemplate.create(garment, MAP)
    truth = wrinkle_normals(points_of(template))
    errors = []
    for config in (SINGLE, replace(SINGLE, temporal_frames=3)):
        (pair,) = frame_pairs(
            template, [4, 5, 6], range(1, 2),
            vertices=lambda _: garment.template.vertices, scan=lambda at: scan_of(noise_m=2e-4, seed=at),
            fps=60.0, config=config,
        )  # fmt: skip
        assert pair.frame_id == 5
        errors.append(angle(pair.high.normals, truth)[pair.high.valid].mean())
    assert errors[1] < 0.7 * errors[0]


def test_windows_do_not_reach_over_gaps():
    ids = [1, 2, 3, 7, 8]
    windows = [temporal_window(ids, at, fps=60, config=ProjectionConfig()) for at in range(5)]
    assert windows == [range(2), range(3), range(1, 3), range(3, 5), range(3, 5)]
    assert temporal_window(ids, 1, fps=20, config=ProjectionConfig()) == range(1, 2)
    with pytest.raises(InputError, match="temporal_frames: expected an odd number, found 2"):
        ProjectionConfig(temporal_frames=2)


def test_tangent_space_and_back_is_the_identity(garment: Garment):
    template = MapTemplate.create(garment, MAP)
    rng = np.random.default_rng(0)
    frames = template.frames(garment.template.vertices + 0.01 * rng.standard_normal(garment.template.vertices.shape))
    normals = rng.standard_normal((len(frames), 3))
    np.testing.assert_allclose(from_tangent(to_tangent(normals, frames), frames), normals, atol=1e-9)
    flat = to_tangent(frames[:, 2], frames)
    np.testing.assert_allclose(flat, np.broadcast_to([0, 0, 1], flat.shape), atol=1e-9)


def test_the_turn_of_the_subject_is_factored_out(garment: Garment):
    template = MapTemplate.create(garment, MAP)
    rng = np.random.default_rng(3)
    frame = garment.template.vertices + 0.02 * rng.standard_normal(garment.template.vertices.shape)
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    turned = frame @ turn.T + np.array([1.0, 2, 3])
    before = template.low_normals(frame) @ template.rotation(frame)
    after = template.low_normals(turned) @ template.rotation(turned)
    np.testing.assert_allclose(after, before, atol=1e-5)
    np.testing.assert_allclose(garment_rotation(frame, turned), turn, atol=1e-9)
    mirrored = frame * np.array([-1, 1, 1])
    assert np.linalg.det(garment_rotation(frame, mirrored)) > 0
