"""Measures of a frame against brute force, and verdicts with reasons."""

from dataclasses import replace

import numpy as np

from capture4d.geometry.mesh import normalised
from registration.config import QualityConfig
from registration.quality import REGION_MEASURES, FrameQuality, assess, border_distances
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


def test_the_tail_of_the_fit_is_told_beside_its_mean(garment, scan_of, config) -> None:
    """One vertex in 36 is 6 mm out: the mean hardly knows, the largest and the share beyond 2 mm do."""
    analysis = analyse_template(garment, config)
    frame = prepare_frame(analysis, scan_of(straight_through, around=216, along=103), config)
    moved = analysis.rest.copy()
    out = np.arange(36 * 5, 36 * 12, 36)
    radial = moved[out] * [1, 0, 1]
    moved[out] += 0.006 * radial / np.linalg.norm(radial, axis=1, keepdims=True)
    numbers = assess(analysis, frame, moved, QualityConfig()).numbers
    assert numbers["fit_mean_mm"] < 0.4
    assert 4 < numbers["fit_max_mm"] < 6.5
    assert numbers["fit_beyond_percent"] == 100 * len(out) / len(moved)
    assert numbers["fit_p95_mm"] <= numbers["fit_p99_mm"] <= numbers["fit_max_mm"]


def test_cloth_behind_another_part_is_unseen_and_no_error(garment, scan_of, config) -> None:
    """A dent whose bottom lies 3 cm behind the wall across it: what is nearest to the bottom is not its own scan."""
    analysis = analyse_template(garment, config)
    scan = scan_of(straight_through)
    frame = prepare_frame(analysis, scan, config)
    assert assess(analysis, frame, analysis.rest, QualityConfig()).numbers["covered_percent"] == 100
    through = analysis.rest.copy()
    pushed = (through[:, 2] > 0.1) & (np.abs(through[:, 1] - 0.25) < 0.08)
    through[pushed, 2] = through[:, 2].min() - 0.015  # out through the back
    quality = assess(analysis, frame, through, QualityConfig())
    assert np.isnan(quality.residual_m[pushed]).all(), "the back has vertices of its own for that scan"
    assert np.isfinite(quality.residual_m[analysis.rest[:, 2] < -0.05]).all()
    assert quality.numbers["fit_max_mm"] < 3


def test_a_spike_in_its_own_cloth_is_an_error(garment, scan_of, config) -> None:
    analysis = analyse_template(garment, config)
    frame = prepare_frame(analysis, scan_of(straight_through), config)
    moved = analysis.rest.copy()
    vertex = 36 * 9
    outwards = moved[vertex] * [1, 0, 1]
    moved[vertex] += 0.012 * outwards / np.linalg.norm(outwards)
    assert 0.008 < assess(analysis, frame, moved, QualityConfig()).residual_m[vertex] < 0.0125


def test_vertices_far_from_their_scan_are_counted_and_to_be_checked(garment, scan_of, config) -> None:
    """One in 648 is told, two are too many."""
    analysis = analyse_template(garment, config)
    frame = prepare_frame(analysis, scan_of(straight_through), config)
    moved, told = analysis.rest.copy(), []
    for vertex in (36 * 6, 36 * 12):
        told.append(assess(analysis, frame, moved, QualityConfig()))
        moved[vertex] += 0.012 * normalised(moved[vertex : vertex + 1] * [1, 0, 1])[0]
    told.append(assess(analysis, frame, moved, QualityConfig()))
    assert [each.numbers["unfitted_vertices"] for each in told] == [0, 1, 2]
    assert [each.verdict for each in told] == ["good", "good", "check"]
    assert told[2].reasons == ("2 vertices with scan data more than 5 mm from it",)
    assert assess(analysis, frame, moved, QualityConfig(unfitted_mm=0)).numbers["unfitted_vertices"] == 0


def test_a_few_faces_that_cut_others_are_to_be_checked(garment, scan_of, config) -> None:
    """Some vertices have changed places with those above them: more faces than one in 500, fewer than one in ten."""
    analysis = analyse_template(garment, config)
    frame = prepare_frame(analysis, scan_of(straight_through), config)
    crossed, below, above = analysis.rest.copy(), 36 * 8 + np.arange(3), 36 * 9 + np.arange(3)
    crossed[below], crossed[above] = analysis.rest[above], analysis.rest[below]
    crossed[[*below, *above]] += 0.003 * normalised(crossed[[*below, *above]] * [1, 0, 1])
    strict, lenient = (
        assess(analysis, frame, crossed, QualityConfig(intersections_check_percent=limit)) for limit in (0.2, 10.0)
    )
    assert 0.2 < 100 * strict.numbers["self_intersections"] / len(analysis.faces) < 10
    assert any("self-intersecting" in reason for reason in strict.reasons)
    assert not any("self-intersecting" in reason for reason in lenient.reasons)


def test_cloth_tucked_behind_itself_is_unseen(garment, scan_of, config) -> None:
    """A ring of the tube lies 15 mm inside, and its neighbours close the wall before it."""
    analysis = analyse_template(garment, config)
    frame = prepare_frame(analysis, scan_of(straight_through), config)
    tucked, row = analysis.rest.copy(), np.arange(len(analysis.rest)) // 36
    height = tucked[36 * 9, 1]
    tucked[row == 8, 1], tucked[row == 10, 1] = height - 0.001, height + 0.001
    inside = row == 9
    level = tucked[inside] * [1, 0, 1]
    tucked[inside] -= 0.015 * level / np.linalg.norm(level, axis=1, keepdims=True)
    tucked[inside, 1] += 0.0004  # it looks neither up nor down, but outwards
    every, own = (assess(analysis, frame, tucked, QualityConfig(unfitted_mm=limit)) for limit in (0.0, 5.0))
    assert np.isfinite(every.residual_m[inside]).any()
    assert np.isnan(own.residual_m[inside]).all()
    assert own.numbers["unfitted_vertices"] == 0


def test_regions_are_measured_and_judged(garment, scan_of, config) -> None:
    """A band of the tube is crumpled: its region says so, the other does not, and the verdict names it."""
    analysis = analyse_template(garment, config)
    frame = prepare_frame(analysis, scan_of(straight_through, around=216, along=103), config)
    height = analysis.rest[:, 1]
    regions = {
        "upper": np.flatnonzero(height > 0.25).astype(np.int32),
        "lower": np.flatnonzero(height <= 0.25).astype(np.int32),
    }
    calm = assess(analysis, frame, analysis.rest, QualityConfig(), regions=regions)
    assert calm.verdict == "good"
    assert all(set(measures) == set(REGION_MEASURES) for measures in calm.regions.values())
    crumpled = analysis.rest.copy()
    rows = (np.arange(len(crumpled)) // 36) % 2 == 1
    inside = rows & (height > 0.26)
    crumpled[inside] -= (
        0.05 * crumpled[inside] * [1, 0, 1] / np.linalg.norm(crumpled[inside] * [1, 0, 1], axis=1)[:, None]
    )
    lenient = QualityConfig(fit_fail_mm=1e3, stretch_fail=1e3, boundary_fail_mm=1e3)  # a failed frame says only why
    quality = assess(analysis, frame, crumpled, lenient, regions=regions)
    assert quality.regions["upper"]["creased_percent"] > 20
    assert quality.regions["lower"]["creased_percent"] < 5
    assert quality.regions["upper"]["fit_beyond_percent"] > quality.regions["lower"]["fit_beyond_percent"]
    assert any(reason.startswith("upper: ") and "creased" in reason for reason in quality.reasons)
    assert not any(reason.startswith("lower: ") for reason in quality.reasons)
