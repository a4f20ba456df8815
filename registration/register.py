"""One template on one scan: a coarse stage on the deformation graph, then a dense stage on every vertex.

References: DeepWrinkles (ECCV 2018), section 3.1, Eq. 1-2; the dense stage and the annealing are ours.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Float64

from capture4d.errors import InputError
from capture4d.types import GarmentScan
from registration.boundary import BorderTargets, border_targets, tangent_free_metric
from registration.cloth_colours import log_colours
from registration.colour_term import ColourPull
from registration.config import BoundaryRule, RegistrationConfig, Schedule
from registration.correspondences import (
    Gates,
    ScanSurface,
    match,
    match_both_ways,
    mesh_normals,
    of_another_part,
    prepare_scan,
)
from registration.deformation_graph import identity_nodes, node_edge_rows, rows_of_vertices, smooth_rows
from registration.energies import (
    edge_vectors,
    plane_metric,
    rigid_term,
    stretch_metric,
    stretch_term,
    tangential_metric,
)
from registration.fold_lengths import folded_lengths
from registration.solver import Rows, RowTerm, SmoothTerm, Term, gauss_newton_step
from registration.template import TemplateAnalysis, require_borders

__all__ = [
    "FrameRegistration",
    "FrameScan",
    "anneal",
    "border_terms",
    "data_term",
    "prepare_frame",
    "register_frame",
]

SHOWN_SPACING_M = 0.003
"""A scan of at most this spacing shows how much of an edge its folds take up. The last weight of the lengths falls with
the fourth power of a coarser one's: what a fold takes goes by the square of slopes, which are rounded off by the square
of the spacing."""
PART_EDGES = 2.5
"""Cloth farther away than so many mean edges at rest is another part of the template."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameScan:
    """A garment scan ready for matching: surface, and painted points with the template's loop numbers."""

    surface: ScanSurface
    border_points: Float64[np.ndarray, "points 3"]
    border_loops: np.ndarray
    """(points,) int32: index of the template's loop, or -1 where the paint does not tell."""
    frame_id: int
    colours: Float64[np.ndarray, "surface_points 3"] | None = None
    """Logarithms of the surface's colours; None where they are not to be compared."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameRegistration:
    """The template on one scan."""

    vertices: Float64[np.ndarray, "verts 3"]
    """Metres, world frame."""
    schedule: Literal["cold", "warm"]
    linear_iterations: int
    """Conjugate gradient iterations over all steps."""


def prepare_frame(analysis: TemplateAnalysis, scan: GarmentScan, config: RegistrationConfig) -> FrameScan:
    """Smooth the scan, take its normals, sort its points into cells, thin its border points.

    Raises:
        UnknownBorderError: a paint is named after a loop that the template lacks.
        InputError: the garment scan is empty.
    """
    if not len(scan.mesh.faces):
        raise InputError(f"frame {scan.frame_id}: expected a garment scan with faces, found none")
    data = config.data
    surface = prepare_scan(
        scan.mesh.vertices, scan.mesh.faces, smoothing_passes=data.smoothing_passes, unshrunk=data.unshrunk
    )
    colours = None if scan.colours is None or not analysis.cloth else log_colours(surface.of_points(scan.colours))
    told = np.unique(scan.boundary_loops[scan.boundary_loops >= 0])
    require_borders(analysis.border, [scan.loop_names[loop] for loop in told])
    stride = max(1, -(-len(scan.boundary_points) // config.boundary.max_points))
    names = {name: index for index, name in enumerate(analysis.border.names)}
    renumbered = np.array([names.get(name, -1) for name in scan.loop_names] + [-1], np.int32)
    loops = renumbered[scan.boundary_loops[::stride]]
    points = scan.boundary_points[::stride].astype(np.float64)
    return FrameScan(surface, points, loops, scan.frame_id, colours)


def register_frame(
    analysis: TemplateAnalysis,
    scan: FrameScan,
    initial_vertices: Float[np.ndarray, "verts 3"],
    *,
    config: RegistrationConfig,
    schedule: Literal["cold", "warm"] = "cold",
) -> FrameRegistration:
    """Deform the template onto one scan by non-rigid ICP.

    Args:
        initial_vertices: start of the search, metres, world frame: the skinned template, or the predicted frame.
        schedule: cold from a distant start, warm from the frame before.
    Raises:
        InputError: no scan vertex lies within the first gate of the start.
    """
    start = np.ascontiguousarray(initial_vertices, np.float64)
    if start.shape != analysis.rest.shape or not np.isfinite(start).all():
        raise InputError(
            f"initial_vertices: expected {len(analysis.rest)} finite vertices of the template, found {start.shape}"
        )
    coarse = config.coarse.cold if schedule == "cold" else config.coarse.warm
    dense = config.dense.cold if schedule == "cold" else config.dense.warm
    vertices, first = _coarse_stage(analysis, scan, start, coarse, config, near=schedule == "warm")
    vertices, second = _dense_stage(analysis, scan, start, vertices, dense, config, near=schedule == "warm")
    return FrameRegistration(vertices, schedule, first + second)


def anneal(pair: tuple[float, float], step: int, steps: int) -> float:
    """Geometric interpolation from first to last; linear if either end is 0."""
    first, last = pair
    share = step / max(steps - 1, 1)
    if first > 0.0 and last > 0.0:
        return first * (last / first) ** share
    return first + (last - first) * share


def _coarse_stage(
    analysis: TemplateAnalysis,
    scan: FrameScan,
    start: np.ndarray,
    schedule: Schedule,
    config: RegistrationConfig,
    *,
    near: bool,
) -> tuple[np.ndarray, int]:
    if schedule.steps == 0:
        return start, 0
    graph, subset = analysis.graph, analysis.coarse_vertices
    count = len(graph.nodes)
    nodes = identity_nodes(count)
    rows = rows_of_vertices(graph, start, np.arange(len(start)))
    constant = start - rows.apply(nodes)
    data_rows = rows_of_vertices(graph, start, subset)
    border_rows = rows_of_vertices(graph, start, analysis.border.vertices)
    node_rows, node_constant = smooth_rows(graph, start)
    pair_rows, pairs = node_edge_rows(graph)
    pair_start = edge_vectors(start[graph.nodes], pairs)
    measured = start if near and config.coarse.start_lengths else analysis.rest
    pair_lengths = np.linalg.norm(edge_vectors(measured[graph.nodes], pairs), axis=1)
    compression = config.coarse.compression if near else config.coarse.cold_compression
    iterations = 0
    vertices = start
    for step in range(schedule.steps):
        at = (step, schedule.steps)
        terms = [data_term(analysis, data_rows, scan.surface, vertices, subset, anneal(schedule.gate, *at), config)]
        if step == 0 and not terms[0].metric.any():
            raise InputError(
                f"frame {scan.frame_id}: expected scan vertices within {schedule.gate[0]:g} m of the start, found none"
            )
        terms += border_terms(
            analysis, border_rows, scan, vertices, anneal(schedule.boundary, *at), config.boundary.gate,
            rule=config.boundary.coarse_rule, along_curve=False,
        )  # fmt: skip
        smooth = anneal(schedule.smooth, *at) / max(len(node_constant), 1)
        metric = np.broadcast_to(smooth * np.eye(3), (len(node_constant), 3, 3))
        terms.append(RowTerm(node_rows, np.ascontiguousarray(metric), node_rows.apply(nodes) + node_constant))
        stretch = anneal(schedule.stretch, *at)
        if stretch > 0.0:
            metric, excess = stretch_metric(
                pair_start + pair_rows.apply(nodes), pair_lengths, weight=stretch, compression=compression
            )
            terms.append(RowTerm(pair_rows, metric, excess))
        rigid = rigid_term(nodes, weight=anneal(schedule.rigid, *at), spacing=graph.spacing)
        change, used = gauss_newton_step(
            terms, rigid, count, damping=1e-6,
            tolerance=config.solver.tolerance, max_iterations=config.solver.max_iterations,
        )  # fmt: skip
        nodes = nodes + change
        vertices = rows.apply(nodes) + constant
        iterations += used
    return vertices, iterations


def _dense_stage(
    analysis: TemplateAnalysis,
    scan: FrameScan,
    start: np.ndarray,
    vertices: np.ndarray,
    schedule: Schedule,
    config: RegistrationConfig,
    *,
    near: bool,
) -> tuple[np.ndarray, int]:
    count = len(vertices)
    every = np.arange(count)
    iterations = 0
    border_rows = Rows.of_points(analysis.border.vertices)
    reference = analysis.laplacian_rows.apply(vertices[:, :, None])
    lengths = analysis.rest_lengths
    if schedule.steps and near and config.dense.fold_lengths:
        lengths = folded_lengths(
            scan.surface, vertices, analysis.faces, analysis.edges, analysis.edge_faces, analysis.rest_lengths
        )
        shown = min(1.0, SHOWN_SPACING_M / scan.surface.spacing) ** 4
        first, last = schedule.stretch
        schedule = replace(schedule, stretch=(first, last * shown))
    pull, steps = None, schedule.steps
    if steps and scan.colours is not None:
        pull, steps = ColourPull(analysis, scan.surface, scan.colours, config.colour), steps + config.colour.steps
    for step in range(steps):
        at = (step, steps)
        gate = anneal(schedule.gate, *at)
        terms: list[Term] = [data_term(analysis, analysis.vertex_rows, scan.surface, vertices, every, gate, config)]
        terms += border_terms(
            analysis, border_rows, scan, vertices, anneal(schedule.boundary, *at), config.boundary.gate,
            rule=config.boundary.dense_rule, along_curve=config.boundary.along_curve,
        )  # fmt: skip
        lengths_term = stretch_term(
            vertices, analysis.edges, lengths,
            weight=anneal(schedule.stretch, *at), compression=config.dense.compression,
        )  # fmt: skip
        if pull is not None:
            raised = (schedule.stretch[0], max(schedule.stretch[1], config.colour.stretch))
            held = stretch_term(
                vertices, analysis.edges, lengths,
                weight=anneal(raised, *at), compression=config.dense.compression,
            )  # fmt: skip
            lengths_term = lengths_term.with_others(held, pull.printed_edges)
        terms.append(lengths_term)
        bending = analysis.laplacian_rows.apply(vertices[:, :, None]) - reference
        terms.append(
            SmoothTerm(
                analysis.laplacian_rows, analysis.laplacian_columns,
                anneal(schedule.smooth, *at) / count, (1.0 - config.dense.plasticity) * bending,
            )
        )  # fmt: skip
        anchor = anneal(schedule.anchor, *at)
        if anchor > 0.0:
            weights, normals = np.full(count, anchor / count), mesh_normals(vertices, analysis.faces)
            terms.append(RowTerm(analysis.vertex_rows, tangential_metric(normals, weights), vertices - start))
        if pull is not None:
            terms.append(pull.term(vertices, step, steps))
        change, used = gauss_newton_step(
            terms, None, count, damping=1e-6,
            tolerance=config.solver.tolerance, max_iterations=config.solver.max_iterations,
        )  # fmt: skip
        vertices = vertices + change[:, :, 0]
        iterations += used
    return vertices, iterations


def data_term(
    analysis: TemplateAnalysis,
    rows: Rows,
    surface: ScanSurface,
    vertices: np.ndarray,
    chosen: np.ndarray,
    gate: float,
    config: RegistrationConfig,
) -> RowTerm:
    """Pull the chosen vertices to the scan."""
    data, points = config.data, vertices[chosen]
    normals = mesh_normals(vertices, analysis.faces)[chosen]
    gates = Gates(gate, data.min_normal_cosine, data.robust_scale)
    if data.rule == "both_ways":
        voters, length = data.max_voters, data.normal_length
        found = match_both_ways(surface, points, normals, gates, neighbours=3, max_points=voters, normal_length=length)
    else:
        found = match(surface, points, normals, gates, of_both=data.normals == "both")
        if data.other_part_share > 0.0:
            away = np.where(found.weights > 0.0, np.linalg.norm(points - found.points, axis=1), 0.0)
            reach = PART_EDGES * float(analysis.rest_lengths.mean())
            found.weights[
                of_another_part(
                    found.points, away, chosen, vertices, analysis.rest, share=data.other_part_share, reach=reach
                )
            ] = 0.0
    metric = plane_metric(found.normals, found.weights / len(points), data.point_share)
    return RowTerm(rows, metric, points - found.points)


def border_terms(
    analysis: TemplateAnalysis,
    rows: Rows,
    scan: FrameScan,
    vertices: np.ndarray,
    weight: float,
    gate: float,
    *,
    rule: BoundaryRule,
    along_curve: bool,
) -> list[RowTerm]:
    """Pull the template's borders to the painted points; nothing where there are none."""
    border = analysis.border
    positions = vertices[border.vertices]
    targets: BorderTargets = border_targets(
        positions, border.loops, scan.border_points, scan.border_loops, rule=rule, gate=gate
    )
    if not targets.valid.any() or weight == 0.0:
        return []
    weights = np.where(targets.valid, weight / len(positions), 0.0)
    if along_curve:
        metric = tangent_free_metric(border.tangents(vertices), weights)
    else:
        metric = weights[:, None, None] * np.eye(3)
    return [RowTerm(rows, metric, positions - targets.points)]
