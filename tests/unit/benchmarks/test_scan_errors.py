"""Scans of a square whose errors are known."""

import numpy as np
import pytest

from benchmarks.scan_errors import scan_errors
from capture4d.types import Mesh
from tests.shapes import plane


def test_scan_errors_of_a_shifted_tilted_scan_with_a_hole():
    truth = plane(1.0, cells=8)
    angle = np.radians(5)
    scan = plane(1.0, cells=200)
    tilted = scan.vertices.copy()
    tilted[:, 1] = np.tan(angle) * (scan.vertices[:, 0] - 0.5)
    left = (scan.vertices[scan.faces][:, :, 0] < 0.75).all(axis=1)
    used = np.unique(scan.faces[left])
    number = np.full(len(tilted), -1, np.int32)
    number[used] = np.arange(len(used), dtype=np.int32)
    part = Mesh(tilted[used], number[scan.faces[left]])
    errors = scan_errors(part, truth, hole_gate_m=0.06)
    assert errors.hole_share == pytest.approx(0.2, abs=0.02)  # the missing quarter, less what lies within the gate
    np.testing.assert_allclose(errors.normal_deg, 5, atol=0.05)
    np.testing.assert_allclose(errors.distance_m, np.abs(part.vertices[:, 1]), atol=1e-6)


def test_the_back_of_a_sheet_counts_as_its_other_side():
    truth = plane(1.0, cells=20)
    back = Mesh(truth.vertices, np.ascontiguousarray(truth.faces[:, ::-1]))
    assert scan_errors(back, truth).normal_deg.max() < 0.1
