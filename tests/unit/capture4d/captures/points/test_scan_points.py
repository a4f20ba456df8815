"""Points of a scan: which are chosen, and which are kept for how long."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture4d.captures.capture import read_capture, read_scan
from capture4d.captures.points.sampling import SamplingConfig
from capture4d.captures.points.scan_points import KeptPoints, label_scan, scan_points
from capture4d.captures.scan_states import scan_looked_at
from capture4d.captures.take_colours import take_colours
from capture4d.geometry.mesh import vertex_normals
from capture4d.geometry.mesh_kernels import first_in_cells, normals_of_some
from capture4d.mesh_files.meshes import read_coloured_mesh, write_mesh


@pytest.mark.parametrize("size", [0.07, 0.3, 5.0])
def test_first_in_cells_are_one_of_each(size: float) -> None:
    rng = np.random.default_rng(0)
    positions = rng.normal(size=(2000, 3)).astype(np.float32)
    candidates = rng.permutation(2000)[:1500]
    cells = [tuple(cell) for cell in np.floor(positions[candidates].astype(float) / size).astype(int).tolist()]
    wanted = [vertex for n, vertex in enumerate(candidates.tolist()) if cells[n] not in cells[:n]]
    assert first_in_cells(positions, candidates, size).tolist() == wanted


def test_normals_of_some_are_those_of_all() -> None:
    rng = np.random.default_rng(1)
    positions, faces = rng.normal(size=(50, 3)), rng.integers(0, 50, (120, 3)).astype(np.int32)
    some = rng.permutation(50)[:20]
    np.testing.assert_allclose(normals_of_some(positions, faces, some), vertex_normals(positions, faces)[some])


def kept_and_made(folder: Path, work: Path, frame_id: int, sampling: SamplingConfig | None = None) -> tuple:
    capture, sampling = read_capture(folder), sampling or SamplingConfig()
    colours = take_colours(capture)
    kept = KeptPoints.of(work, capture, colours, sampling)
    with scan_looked_at(capture, frame_id) as looked:
        flat = colours.flat(read_scan(capture, frame_id))
        made = scan_points(flat, label_scan(flat, colours), sampling)
    return kept, made, looked


def test_points_are_kept_exactly(tube_capture: Path, tmp_path: Path) -> None:
    """So that it makes no difference whether they were kept."""
    kept, made, looked = kept_and_made(tube_capture, tmp_path / "work", 6)
    assert kept.read(6) is None
    kept.write(6, made, looked)
    again = kept.read(6)
    assert again is not None
    for name in ("points", "normals", "cloth"):
        np.testing.assert_array_equal(getattr(again[0], name), getattr(made, name))
    assert [each.digest for each in again[1]] == [each.digest for each in looked]


def test_kept_points_of_something_else_do_not_count(tube_capture: Path, tmp_path: Path) -> None:
    kept, made, looked = kept_and_made(tube_capture, tmp_path / "work", 6)
    kept.write(6, made, looked)
    capture = read_capture(tube_capture)
    colours = take_colours(capture)
    others = [
        KeptPoints.of(tmp_path / "work", capture, colours, SamplingConfig(body_cell_m=0.02)),
        KeptPoints.of(tmp_path / "work", capture, replace(colours, garment=(1, 2, 3)), SamplingConfig()),
        KeptPoints.of(tmp_path / "work", replace(capture, units="mm"), colours, SamplingConfig()),
    ]
    assert [each.read(6) for each in others] == [None, None, None]
    path = next((tmp_path / "work" / "points").glob("*.npz"))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert kept.read(6) is None


def test_kept_points_of_a_replaced_scan_do_not_count(tube_capture: Path, tmp_path: Path) -> None:
    kept, made, looked = kept_and_made(tube_capture, tmp_path / "work", 6)
    kept.write(6, made, looked)
    scan = kept.capture.files.scans[6] if kept.capture.files else Path()
    found = read_coloured_mesh(scan)
    write_mesh(scan, found.mesh.with_vertices(found.mesh.vertices + np.float32(0.01)), colours=found.colours)
    assert kept.read(6) is None
