"""Garment scans as files: their colours come back, and files without any are read as ever."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture4d.captures.garment_scans import load_garment_scan, save_garment_scan
from capture4d.errors import InputError
from capture4d.types import GarmentScan, Mesh


@pytest.fixture
def scan() -> GarmentScan:
    mesh = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32))
    colours = np.array([[1, 2, 3], [40, 50, 60], [255, 0, 9]], np.uint8)
    return GarmentScan(mesh, mesh.vertices[:1], np.zeros(1, np.int32), ("hem",), 7, colours)


def test_colours_come_back(scan: GarmentScan, tmp_path: Path) -> None:
    save_garment_scan(tmp_path / "a.npz", scan)
    found = load_garment_scan(tmp_path / "a.npz", 7)
    np.testing.assert_array_equal(found.colours, scan.colours)
    np.testing.assert_array_equal(found.mesh.vertices, scan.mesh.vertices)


def test_files_without_colours_are_read_as_ever(scan: GarmentScan, tmp_path: Path) -> None:
    save_garment_scan(tmp_path / "a.npz", replace(scan, colours=None))
    with np.load(tmp_path / "a.npz") as arrays:
        assert "colours" not in arrays
    assert load_garment_scan(tmp_path / "a.npz", 7).colours is None


def test_colours_are_one_for_each_vertex(scan: GarmentScan) -> None:
    assert scan.colours is not None
    with pytest.raises(InputError, match="colours"):
        replace(scan, colours=scan.colours[:2])
