"""Previews: near the scan, of the grid's size, and of the scan that is there now."""

import os
from pathlib import Path

import numpy as np
import pytest

from capture4d.app.viewer.previews import clustered, prepare, preview_folder, scan_preview
from capture4d.captures.capture import read_capture, read_scan
from capture4d.geometry.ray_casting import surface_distances
from tests.shapes import tube


@pytest.mark.parametrize("cell", [0.004, 0.01, 0.05])
def test_a_vertex_for_each_cell_and_none_farther_than_its_diagonal(cell: float):
    mesh = tube(120, 90, 0.15)
    rng = np.random.default_rng(1)
    colours = rng.integers(0, 256, (len(mesh.vertices), 3)).astype(np.uint8)
    coarse, painted = clustered(mesh.vertices, mesh.faces, colours, cell)
    cells = {*map(tuple, np.floor((mesh.vertices - mesh.vertices.min(axis=0)) / cell).astype(int).tolist())}
    assert len(coarse.vertices) == len(painted) == len(cells)
    assert surface_distances(mesh, coarse.vertices).max() < cell * np.sqrt(3)
    assert (np.diff(np.sort(coarse.faces, axis=1), axis=1) > 0).all(), "no face has a corner twice"
    assert len({*map(tuple, coarse.faces.tolist())}) == len(coarse.faces)


def test_faces_keep_their_side():
    mesh = tube(60, 40, 0.15)
    coarse, _ = clustered(mesh.vertices, mesh.faces, np.zeros((len(mesh.vertices), 3), np.uint8), 0.03)
    a, b, c = (coarse.vertices[coarse.faces[:, k]] for k in range(3))
    outwards = (np.cross(b - a, c - a)[:, [0, 2]] * (a + b + c)[:, [0, 2]]).sum(axis=1)
    assert (outwards > 0).mean() > 0.97


def test_colours_are_the_mean_of_a_cell():
    vertices = np.array([[0, 0, 0], [0.001, 0, 0], [1, 0, 0]], np.float32)
    colours = np.array([[10, 0, 200], [20, 100, 100], [7, 8, 9]], np.uint8)
    _, painted = clustered(vertices, np.zeros((0, 3), np.int32), colours, 0.01)
    np.testing.assert_array_equal(painted, [[15, 50, 150], [7, 8, 9]])


def test_kept_and_made_anew_for_another_scan(tube_capture: Path):
    capture = read_capture(tube_capture)
    folder = preview_folder(tube_capture, 10)
    assert prepare(capture, folder, 10, workers=1) == []
    files = sorted(path.name for path in folder.iterdir())
    assert files == ["000005.npz", "000006.npz", "000007.npz"]
    mesh, colours = scan_preview(capture, 6, folder, 10)
    scan = read_scan(capture, 6)
    wanted, painted = clustered(scan.mesh.vertices, scan.mesh.faces, scan.colours, 0.01)
    np.testing.assert_array_equal(mesh.faces, wanted.faces)
    np.testing.assert_array_equal(colours, painted)
    np.testing.assert_allclose(mesh.vertices, wanted.vertices, atol=1e-5)
    before = (folder / "000006.npz").stat().st_mtime_ns
    scan_preview(capture, 6, folder, 10)
    assert (folder / "000006.npz").stat().st_mtime_ns == before, "what is there is read"
    os.replace(tube_capture / "scans" / "000007.ply", tube_capture / "scans" / "000006.ply")
    changed, _ = scan_preview(capture, 6, folder, 10)
    other = read_scan(capture, 6).mesh
    assert surface_distances(other, changed.vertices).max() < 0.02
    assert surface_distances(scan.mesh, changed.vertices).max() > 0.005
    assert (folder / "000006.npz").stat().st_mtime_ns != before


def test_scans_that_cannot_be_read_are_named(tube_capture: Path):
    capture = read_capture(tube_capture)
    (tube_capture / "scans" / "000006.ply").write_bytes(b"ply\n")
    assert prepare(capture, preview_folder(tube_capture, 10), 10, workers=1) == [6]


def test_a_damaged_preview_is_made_again(tube_capture: Path):
    capture, folder = read_capture(tube_capture), preview_folder(tube_capture, 10)
    good, _ = scan_preview(capture, 5, folder, 10)
    (folder / "000005.npz").write_bytes(b"no")
    again, _ = scan_preview(capture, 5, folder, 10)
    np.testing.assert_allclose(again.vertices, good.vertices, atol=1e-5)
