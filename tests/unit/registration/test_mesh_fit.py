"""Verdicts on two meshes: what swung is doubted, what was only carried elsewhere is not."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from registration.config import ScanFitConfig
from registration.mesh_fit import judge
from registration.quality import assess
from registration.register import prepare_frame
from registration.template import analyse_template

TURN = Rotation.from_euler("y", 35, degrees=True).as_matrix()


def bent(points: np.ndarray) -> np.ndarray:
    """Sheared more and more towards the upper end, by 0.2 m at 0.5 m."""
    return points + np.column_stack([0.8 * points[:, 1] ** 2, np.zeros((len(points), 2))])


def carried(points: np.ndarray) -> np.ndarray:
    return points @ TURN.T + np.array([0.3, -0.1, 0.2])


@pytest.mark.parametrize(("move", "doubted"), [(bent, True), (carried, False)])
def test_what_has_swung_is_to_be_checked(move, doubted: bool, garment, scan_of, config) -> None:
    analysis = analyse_template(garment, config)
    scan = prepare_frame(analysis, scan_of(move), config)
    vertices = move(analysis.rest)
    quality = assess(analysis, scan, vertices, config.quality)
    limits = ScanFitConfig(swung_check_mm=10.0)
    verdict, reasons = judge(quality, analysis, scan, vertices, limits, start=analysis.rest)
    assert any("beyond a rigid motion" in reason for reason in reasons) == doubted
    assert verdict != "failed"
