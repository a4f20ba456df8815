"""The small-step solver against what is known of hanging, sliding and bent sheets."""

from __future__ import annotations

import numpy as np
import pytest

from data_synth.cloth.panels import Edge, Panel, Pattern, line
from data_synth.cloth.patterns import PanelMesh, mesh_pattern
from data_synth.drapes.config import Cloth
from data_synth.drapes.solver import FRAME_SUBSTEPS, Planes, Sheet, advance, keep_lengths, push_out

CLOTH = Cloth()
NOTHING = Planes(np.zeros(0, np.int32), np.zeros((0, 3)), np.zeros((0, 3)))


def strip(width: float = 0.1, height: float = 0.3, vertices: int = 200) -> PanelMesh:
    """A rectangle whose upper edge is at v = 0."""
    left, right = -width / 2, width / 2
    corners = [(left, -height), (right, -height), (right, 0.0), (left, 0.0)]
    edges = tuple(
        Edge(line(a, b), f"outline|{i}")
        for i, (a, b) in enumerate(zip(corners, corners[1:] + corners[:1], strict=True))
    )
    pattern = Pattern((Panel("front", edges),), borders=("outline",))
    return mesh_pattern(pattern, vertices, np.random.default_rng(0), symmetric=True)


def run(sheet: Sheet, points: np.ndarray, planes: Planes, frames: int, keep: float = 0.97) -> np.ndarray:
    points, velocities = points.copy(), np.zeros_like(points)
    hold = np.zeros_like(points), np.zeros(len(points))
    for _ in range(frames):
        advance(sheet, points, velocities, hold, planes, margin=0.0, keep=keep, substeps=FRAME_SUBSTEPS)
    return points


def flat(mesh: PanelMesh) -> np.ndarray:
    return np.column_stack([mesh.vertex_uv, np.zeros(mesh.vertex_count)])


def test_a_pinned_strip_hangs_straight_and_hardly_longer():
    mesh = strip()
    start = flat(mesh)
    top = np.flatnonzero(start[:, 1] > -1e-9)
    end = run(Sheet.create(mesh, CLOTH, top), start, NOTHING, frames=60)
    np.testing.assert_array_equal(end[top], start[top])
    stretch = np.ptp(end[:, 1]) / np.ptp(start[:, 1])
    assert 1.0 < stretch < 1.015


def test_the_mirror_image_of_a_start_gives_the_mirror_image():
    mesh, flip = strip(), np.array([-1.0, 1.0, 1.0])
    assert mesh.mirror is not None
    top = np.flatnonzero(flat(mesh)[:, 1] > -1e-9)
    sheet = Sheet.create(mesh, CLOTH, top)
    start = flat(mesh) + np.random.default_rng(1).normal(scale=1e-3, size=(mesh.vertex_count, 3))
    start[top] = flat(mesh)[top]
    end = run(sheet, start, NOTHING, frames=20)
    image = run(sheet, (start * flip)[mesh.mirror], NOTHING, frames=20)
    moved = np.linalg.norm(end - start, axis=1).mean()
    assert np.linalg.norm(image[mesh.mirror] * flip - end, axis=1).mean() < 0.2 * moved


@pytest.mark.parametrize(("friction", "slides"), [(0.1, True), (0.8, False)])
def test_cloth_slides_down_a_slope_that_is_steeper_than_its_friction(friction: float, slides: bool):
    mesh = strip(height=0.1, vertices=80)
    slope = np.radians(20)  # tangent .36
    normal = np.array([0.0, np.cos(slope), np.sin(slope)])
    downhill = np.array([0.0, -np.sin(slope), np.cos(slope)])
    start = mesh.vertex_uv[:, :1] * (1.0, 0.0, 0.0) - mesh.vertex_uv[:, 1:] * downhill
    planes = Planes(
        np.arange(mesh.vertex_count, dtype=np.int32),
        np.zeros((mesh.vertex_count, 3)),
        np.tile(normal, (mesh.vertex_count, 1)),
    )
    sheet = Sheet.create(mesh, Cloth(friction=friction), np.zeros(0, int))
    moved = (run(sheet, start, planes, frames=12, keep=1.0) - start) @ downhill
    if slides:  # g (sin - f cos) t^2 / 2
        assert moved.mean() == pytest.approx(0.5 * 9.81 * (np.sin(slope) - friction * np.cos(slope)) * 0.2**2, rel=0.1)
    else:
        assert np.abs(moved).max() < 2e-3


def test_stiffer_cloth_bends_less():
    mesh = strip(width=0.06, height=0.15)
    start = np.column_stack([mesh.vertex_uv[:, 0], np.zeros(mesh.vertex_count), -mesh.vertex_uv[:, 1]])
    clamped = np.flatnonzero(mesh.vertex_uv[:, 1] > mesh.vertex_uv[:, 1].max() - 0.015)
    reach = [
        run(Sheet.create(mesh, Cloth(bending=bending), clamped), start, NOTHING, frames=150, keep=0.985)[:, 2].max()
        for bending in (1e-5, 1e-4, 1e-3)
    ]
    assert 1.3 * reach[0] < reach[1]
    assert 1.1 * reach[1] < reach[2]  # one sweep a step makes it hardly stiffer


def test_cloth_gives_way_in_compression_as_a_bar_of_two_stiffnesses():
    """A flat strip held at both ends hangs on the upper one by the root of the share of stiffness in compression:
    N = w L / (1 + sqrt(c)), and sags by N^2 / (2 Y w)."""
    mesh = strip()
    start = flat(mesh)
    ends = np.flatnonzero(np.abs(start[:, 1] + 0.15) > 0.15 - 1e-9)
    sags = []
    for share in (1.0, 0.25):
        cloth = Cloth(
            stretch_stiffness=10.0, compression_stiffness=10.0 * share, strain_limit=2.0, compression_limit=0.0
        )
        end = run(Sheet.create(mesh, cloth, ends), start, NOTHING, frames=60)
        assert np.abs(end[:, 2]).max() < 1e-9
        sags.append((start - end)[np.abs(start[:, 0]) < 0.02, 1].max())
    assert sags[1] / sags[0] == pytest.approx((2 / (1 + 0.25**0.5)) ** 2, rel=0.1)


def test_an_edge_is_hardly_shorter_than_its_limit():
    mesh = strip()
    start = flat(mesh) * (1.0, 0.7, 1.0)
    sheet = Sheet.create(mesh, Cloth(compression_stiffness=1e-3), np.flatnonzero(start[:, 1] > -1e-9))
    end = run(sheet, start, NOTHING, frames=4)
    lengths = np.linalg.norm(end[sheet.edges[:, 1]] - end[sheet.edges[:, 0]], axis=1)
    assert (lengths / sheet.lengths).min() > 0.75


def test_lengths_are_kept_within_their_limits_and_what_is_pinned_stays():
    mesh = strip()
    start = flat(mesh) + np.random.default_rng(2).normal(scale=2e-3, size=(mesh.vertex_count, 3))
    top = np.flatnonzero(flat(mesh)[:, 1] > -1e-9)
    sheet, points = Sheet.create(mesh, CLOTH, top), start.copy()
    apart = []
    for _ in range(4):
        lengths = np.linalg.norm(points[sheet.edges[:, 1]] - points[sheet.edges[:, 0]], axis=1) / sheet.lengths
        apart.append(np.maximum(lengths - CLOTH.strain_limit, CLOTH.compression_limit - lengths).clip(0).sum())
        keep_lengths(sheet, points)
    assert apart[0] > 3 * apart[1] > 9 * apart[3]
    np.testing.assert_array_equal(points[top], start[top])
    within = flat(mesh)
    keep_lengths(sheet, within)
    np.testing.assert_array_equal(within, flat(mesh))


def test_what_is_too_near_the_body_is_pushed_to_its_distance_and_no_farther_at_once():
    heights = np.array([-0.01, -0.001, 0.001, 0.02])
    points = np.column_stack([np.arange(4.0), heights, np.zeros(4)])
    planes = Planes(np.arange(4, dtype=np.int32), points * (1, 0, 0), np.tile([0.0, 1.0, 0.0], (4, 1)))
    for farthest, expected in ((0.003, [-0.007, 0.002, 0.002, 0.02]), (np.inf, [0.002, 0.002, 0.002, 0.02])):
        moved = points.copy()
        push_out(moved, planes, margin=0.002, farthest=farthest)
        np.testing.assert_allclose(moved, np.column_stack([points[:, 0], expected, points[:, 2]]), atol=1e-15)
