"""Measures of a frame against brute force, and verdicts with reasons."""

from dataclasses import replace

import numpy as np

from registration.config import QualityConfig
from registration.quality import FrameQuality, assess, border_distances
from registration.register import prepare_frame
from registration.template import analyse_template


def straight_through(points: np.ndarray) -> np.ndarray:
    return points


def test_a_perfect_frame_is_good(garment, scan_of, config) -> None:
    analysis = analyse_template(garment, config)
    frame = prepare_frame(analysis, scan_of(straight_through, around=216, along=103), config)
    quality = assess(analysis, frame, analysis.rest, QualityConfig())
    assert quality.verdict == "good"
    assert not quality.reasons
    assert quality.numbers["fit_mean_mm"] < 0.3
    assert quality.numbers["boundary_mean_mm"] < 1.5
    assert quality.numbers["stretch_p99"] == 1.0
    assert quality.numbers["flipped_faces"] == quality.numbers["self_intersections"] == 0
    assert quality.numbers["covered_percent"] == 100


def test_an_offset_is_measured_and_named(garment, scan_of, config) -> None:
    analysis = analyse_template(garment, config)
    frame = prepare_frame(analysis, scan_of(straight_through), config)
    grown = analysis.rest * [1.05, 1.0, 1.05]
    quality = assess(analysis, frame, grown, QualityConfig())
    assert quality.verdict == "failed"
    assert any(reason.startswith("fit_mean_mm") for reason in quality.reasons)
    assert 5 < quality.numbers["fit_mean_mm"] < 10


def test_every_measure_is_told_where_it_is(garment, scan_of, config) -> None:
    """Half of the hem is off its paint, one row of edges is stretched, one vertex is pushed through the cloth."""
    analysis = analyse_template(garment, config)
    scan = scan_of(straight_through)
    frame = prepare_frame(analysis, scan, config)
    hem, neck = garment.loops["hem"], garment.loops["neck"]
    moved = analysis.rest.copy()
    moved[neck, 1] += 0.006
    quality = assess(analysis, frame, moved, QualityConfig())
    border = np.zeros(len(moved), bool)
    border[np.concatenate([hem, neck])] = True
    assert (np.isfinite(quality.border_error_m) == border).all()
    np.testing.assert_allclose(quality.border_error_m[neck], 0.006, atol=1.5e-3)
    assert quality.border_error_m[hem].max() < 0.004
    away = analysis.rest[:, 1] < 0.45
    np.testing.assert_allclose(quality.stretch[away], 1.0)
    for vertex in (int(neck[0]), int(hem[0])):
        lengths = [
            np.linalg.norm(moved[a] - moved[b]) / rest
            for (a, b), rest in zip(analysis.edges, analysis.rest_lengths, strict=True)
            if vertex in (a, b)
        ]
        assert quality.stretch[vertex] == np.mean(lengths)
    assert not quality.flipped.any()
    turned = replace(scan, mesh=replace(scan.mesh, faces=scan.mesh.faces[:, ::-1].copy()))
    assert assess(analysis, prepare_frame(analysis, turned, config), analysis.rest, QualityConfig()).flipped.all()


def test_borders_without_paint_have_no_error(garment, scan_of, config) -> None:
    scan = scan_of(straight_through)
    seen = scan.boundary_loops == 0
    hem_only = replace(scan, boundary_points=scan.boundary_points[seen], boundary_loops=scan.boundary_loops[seen])
    analysis = analyse_template(garment, config)
    quality = assess(analysis, prepare_frame(analysis, hem_only, config), analysis.rest, QualityConfig())
    assert np.isfinite(quality.border_error_m[garment.loops["hem"]]).all()
    assert np.isnan(quality.border_error_m[garment.loops["neck"]]).all()


def test_arrays_are_stored_small_and_by_name(garment, scan_of, config) -> None:
    analysis = analyse_template(garment, config)
    quality = assess(
        analysis, prepare_frame(analysis, scan_of(straight_through), config), analysis.rest, QualityConfig()
    )
    for arrays in (quality.vertex_arrays(), FrameQuality.unmeasured(len(analysis.rest), "no scan").vertex_arrays()):
        assert {name: array.dtype.name for name, array in arrays.items()} == {
            "residual_m": "float32", "border_error_m": "float32", "stretch": "float32", "flipped": "bool",
        }  # fmt: skip
        assert {len(array) for array in arrays.values()} == {len(analysis.rest)}


def test_holes_have_no_residual(garment, scan_of, config) -> None:
    scan = scan_of(straight_through)
    kept = scan.mesh.vertices[scan.mesh.faces].mean(axis=1)[:, 0] < 0.05
    holed = replace(scan, mesh=replace(scan.mesh, faces=scan.mesh.faces[kept]))
    analysis = analyse_template(garment, config)
    quality = assess(analysis, prepare_frame(analysis, holed, config), analysis.rest, QualityConfig())
    beyond = analysis.rest[:, 0] > 0.08
    assert np.isnan(quality.residual_m[beyond]).all()
    assert np.isfinite(quality.residual_m[analysis.rest[:, 0] < 0.04]).all()


def test_inside_out_is_noticed(garment, scan_of, config) -> None:
    analysis = analyse_template(garment, config)
    scan = scan_of(straight_through)
    turned = replace(scan, mesh=replace(scan.mesh, faces=scan.mesh.faces[:, ::-1].copy()))
    quality = assess(analysis, prepare_frame(analysis, turned, config), analysis.rest, QualityConfig())
    assert quality.numbers["flipped_faces"] == len(analysis.faces)
    assert quality.verdict == "check"


def test_border_distances_go_both_ways(garment, scan_of, config) -> None:
    analysis = analyse_template(garment, config)
    frame = prepare_frame(analysis, scan_of(lambda p: p + np.array([0, 0.004, 0])), config)
    distances = border_distances(analysis, frame, analysis.rest)
    np.testing.assert_allclose(np.median(distances), 0.004, atol=5e-4)
    assert len(distances) > len(analysis.border.vertices)


def test_a_hidden_stretch_of_border_is_not_an_error(garment, scan_of, config) -> None:
    scan = scan_of(straight_through)
    seen = scan.boundary_points[:, 0] > 0
    half = replace(scan, boundary_points=scan.boundary_points[seen], boundary_loops=scan.boundary_loops[seen])
    analysis = analyse_template(garment, config)
    quality = assess(analysis, prepare_frame(analysis, half, config), analysis.rest, QualityConfig())
    assert quality.numbers["boundary_mean_mm"] < 3
