"""Verdicts on two meshes: what swung is doubted, what was only carried elsewhere is not."""

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.geometry.mesh import submesh
from capture4d.types import Garment, GarmentScan, Mesh
from registration import mesh_fit
from registration.config import MeshRegistrationConfig, ScanFitConfig, SettleConfig
from registration.correspondences import mesh_normals
from registration.mesh_verdict import judge
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


@pytest.mark.parametrize(("off", "swing_mm", "lost"), [(0.004, 500.0, True), (0.0, 500.0, False), (0.0, 45.0, True)])
def test_a_part_that_went_elsewhere_has_failed_and_what_is_not_scanned_is_to_be_checked(
    off: float, swing_mm: float, lost: bool, garment, scan_of, config
) -> None:
    """The scan shows the lower part; the upper one lies elsewhere, and the rest upon the scan, or 4 mm beside it. What
    has swung too far for a part of the same thing has failed in any case."""
    analysis = analyse_template(garment, config)
    whole = scan_of(lambda points: points)
    lower = whole.mesh.faces[(whole.mesh.vertices[whole.mesh.faces, 1] < 0.3).all(axis=1)]
    mesh, _ = submesh(Mesh(whole.mesh.vertices, lower), np.ones(len(lower), bool))
    none = np.zeros((0, 3), np.float32)
    scan = prepare_frame(analysis, GarmentScan(mesh, none, np.zeros(0, np.int32), (), 0), config)
    vertices = analysis.rest + off * mesh_normals(analysis.rest, analysis.faces)
    vertices[analysis.rest[:, 1] > 0.32, 0] += 0.3
    quality = replace(assess(analysis, scan, vertices, config.quality), verdict="good", reasons=())
    limits = ScanFitConfig(swung_check_mm=swing_mm)
    verdict, reasons = judge(quality, analysis, scan, vertices, limits, start=analysis.rest)
    assert verdict == ("failed" if lost else "check")
    assert any("far from the scan" in reason for reason in reasons)


@pytest.mark.parametrize("off_m", [0.0, 3.0])
def test_where_nothing_lies_near_the_way_from_afar_starts_from_a_rigid_motion_alone(
    off_m: float, garment, scan_of, config, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No way is said to reach the scan, so that all of them are tried."""
    starts = []

    def approach(analysis, surface, start, *_, **__) -> np.ndarray:
        starts.append(start)
        return start

    monkeypatch.setattr(mesh_fit, "approach", approach)
    monkeypatch.setattr(mesh_fit, "reaches", lambda *_: False)
    scan = scan_of(lambda points: points + np.array([off_m, 0.0, 0.0]))
    rest = garment.template.vertices.astype(np.float64)
    few = replace(config, dense=replace(config.dense, cold=replace(config.dense.cold, steps=1)))
    few = replace(few, coarse=replace(config.coarse, cold=replace(config.coarse.cold, steps=1)))
    mesh_fit.fit_mesh(
        garment, scan, rest, MeshRegistrationConfig(lengths="kept", registration=few, settle=SettleConfig(steps=1))
    )
    assert starts
    assert np.allclose(starts[0], rest) == (off_m == 0.0)
    for start in starts:
        assert abs(start[:, 0].mean() - scan.mesh.vertices[:, 0].mean()) < 0.1


@pytest.mark.parametrize(("move", "first"), [(bent, "approach"), (lambda points: points + 0.01, "register_frame")])
def test_where_limbs_are_out_of_reach_the_way_from_afar_comes_first(
    move, first: str, garment, scan_of, config, monkeypatch: pytest.MonkeyPatch
) -> None:
    bare, scan = Garment(garment.template, {}), unpainted(scan_of(move))
    called = []
    for name in ("approach", "register_frame"):
        make = getattr(mesh_fit, name)
        monkeypatch.setattr(
            mesh_fit, name, lambda *given, name=name, make=make, **how: called.append(name) or make(*given, **how)
        )
    monkeypatch.setattr(mesh_fit, "reaches", lambda *_: True)
    few = MeshRegistrationConfig(lengths="kept", registration=config, settle=SettleConfig(steps=1))
    mesh_fit.fit_mesh(bare, scan, garment.template.vertices.astype(np.float64), few)
    assert called[0] == first


def test_what_is_not_reached_from_afar_is_tried_once_more_from_there(
    garment, scan_of, config, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Narrower, and from where the first attempt has led."""
    tries = []

    def approach(analysis, surface, start, votes, *, signatures, landmarks) -> np.ndarray:
        tries.append((votes.signature_width, start))
        return start + 0.02

    monkeypatch.setattr(mesh_fit, "approach", approach)
    monkeypatch.setattr(mesh_fit, "reaches", lambda *_: len(tries) == 2)
    rest = garment.template.vertices.astype(np.float64)
    few = MeshRegistrationConfig(lengths="kept", registration=config, settle=SettleConfig(steps=1))
    fitted = mesh_fit.fit_mesh(Garment(garment.template, {}), unpainted(scan_of(bent)), rest, few)
    widths = [width for width, _ in tries]
    assert widths == [few.approach.signature_width, few.approach.again_width]
    np.testing.assert_array_equal(tries[0][1], rest)
    assert np.abs(tries[1][1] - rest).max() > 0.005
    assert fitted.way in ("far", "again")


@pytest.mark.parametrize(("lengths", "heights"), [("auto", {0.5, 0.6}), ("kept", {0.5})])
def test_a_scan_of_another_size_is_measured_once_and_not_searched_for_with_wider_votes(
    lengths: Literal["auto", "kept"],
    heights: set[float],
    garment,
    scan_of,
    config,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Lengths that are another's are not reached from farther off; the template is made as large instead, if it may."""
    measured, widths = [], []
    signatures = mesh_fit.geodesic_signatures

    def approach(analysis, surface, start, votes, **_) -> np.ndarray:
        widths.append((float(np.ptp(analysis.rest[:, 1])), votes.width[0]))
        return start

    monkeypatch.setattr(mesh_fit, "geodesic_signatures", lambda *mesh: measured.append(mesh) or signatures(*mesh))
    monkeypatch.setattr(mesh_fit, "approach", approach)
    monkeypatch.setattr(mesh_fit, "reaches", lambda *_: False)
    for known in ("swung", "of_doubtful_size"):
        monkeypatch.setattr(mesh_fit._Attempts, known, True)
    once = replace(config, dense=replace(config.dense, cold=replace(config.dense.cold, steps=1)))
    once = replace(once, coarse=replace(config.coarse, cold=replace(config.coarse.cold, steps=1)))
    few = MeshRegistrationConfig(lengths=lengths, registration=once, soft=once, settle=SettleConfig(steps=1))
    larger = unpainted(scan_of(lambda points: 1.25 * points))
    mesh_fit.fit_mesh(Garment(garment.template, {}), larger, garment.template.vertices.astype(np.float64), few)
    assert len(measured) == 2
    assert {round(height, 1) for height, _ in widths} == heights
    wide = few.approach.wide.width[0]
    assert ((0.5, wide) in {(round(height, 1), width) for height, width in widths}) == (lengths == "kept")


def unpainted(scan: GarmentScan) -> GarmentScan:
    return replace(scan, boundary_points=scan.boundary_points[:0], boundary_loops=scan.boundary_loops[:0])


@pytest.mark.parametrize("weight", [0.1, 0.0])
def test_a_rim_without_weight_leaves_borders_to_their_points(weight: float, garment, scan_of, monkeypatch) -> None:
    seen, settle = [], mesh_fit.settle

    def spy(*given, rim):
        seen.append(rim)
        return settle(*given, rim=rim)

    monkeypatch.setattr(mesh_fit, "settle", spy)
    scan = replace(scan_of(lambda points: points), boundary_loops=np.full(320, -1, np.int32))
    rim = scan.boundary_points + np.float32(0.015) * np.sign(0.25 - scan.boundary_points[:, 1:2]) * np.eye(3)[1]
    config = MeshRegistrationConfig(settle=SettleConfig(steps=1, rim=weight))
    mesh_fit.fit_mesh(garment, scan, garment.template.vertices.astype(np.float64), config, rim_points=rim)
    assert all((each is None) == (weight == 0.0) for each in seen)
    assert seen
