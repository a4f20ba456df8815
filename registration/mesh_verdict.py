"""Whether two meshes belong together as they were brought: when an attempt has reached its scan, and the verdict."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from registration.alignment import fit_similarity
from registration.config import ScanFitConfig
from registration.quality import FrameQuality, scan_distances
from registration.register import FrameScan
from registration.template import TemplateAnalysis

__all__ = ["BORDER_MM", "CLOTH_BORDER_MM", "is_tight", "judge", "reaches"]

BORDER_MM = 5.0
"""Mean distance of the template's open borders from the scan above which it does not end where the scan does."""
CLOTH_BORDER_MM = 15.0
"""The same for cloth that has its lengths: where they leave a border, the scan lacks some of it (8 to 11 mm of a shirt
in its true place, carried off, whose scan has holes)."""
FACETS = 0.05
"""Share of an edge by which a face may cut off what is round: a coarse template has not failed for it."""
TIGHT_MM, TIGHT_STRETCH = 0.8, 1.6
"""Mean distance from template to scan, and 99th percentile of the stretch, of what needs no other attempt."""


def is_tight(quality: FrameQuality) -> bool:
    """Whether the template hugs the scan without being stretched for it."""
    numbers = quality.numbers
    return numbers["fit_mean_mm"] <= TIGHT_MM and numbers["stretch_p99"] <= TIGHT_STRETCH


def reaches(
    analysis: TemplateAnalysis, scan: FrameScan, vertices: np.ndarray, config: ScanFitConfig, border_mm: float
) -> bool:
    """Whether the template lies on all of the scan, beyond its borders as well, and ends where the scan does.

    Args:
        border_mm: mean distance of the template's open borders from the scan, up to which it does.
    """
    away = 1e3 * scan_distances(analysis, scan, vertices)[0]
    border = vertices[analysis.border.vertices]
    hanging = 1e3 * float(scan.surface.grid.query(border)[0].mean()) if len(border) else 0.0
    ends = hanging <= border_mm + 1e3 * scan.surface.spacing
    return bool(ends and away.mean() <= config.check_mm and np.percentile(away, 95) <= config.far_check_mm)


def judge(
    quality: FrameQuality,
    analysis: TemplateAnalysis,
    scan: FrameScan,
    vertices: Float64[np.ndarray, "verts 3"],
    config: ScanFitConfig,
    *,
    start: Float64[np.ndarray, "verts 3"],
    length_factor: float = 1.0,
) -> tuple[str, tuple[str, ...]]:
    """Verdict and reasons, with what a take's frames are not judged by: what of the scan the template leaves unreached,
    and how far it has swung.

    Args:
        start: where the template lay, metres.
        length_factor: the reasons give lengths times this.
    """
    every, nearest = scan_distances(analysis, scan, vertices)
    beyond = np.isin(nearest, analysis.border.vertices)  # of an open border, where the scan may go on
    away = every if beyond.all() else every[~beyond]
    mean, far = 1e3 * float(away.mean()), 1e3 * float(np.percentile(away, 95))
    facets = 1e3 * FACETS * float(analysis.rest_lengths.mean())
    past = 100.0 * float((beyond & (1e3 * every > config.far_fail_mm)).mean())
    rigid = fit_similarity(start, vertices, with_scale=False).apply(start)
    swung = 1e3 * float(np.linalg.norm(vertices - rigid, axis=1).mean())
    lost = 100.0 * float((1e3 * scan.surface.grid.query(vertices)[0] > config.far_fail_mm).mean())
    unreached = mean > config.check_mm + facets or far > config.far_check_mm + facets
    lost_limit = config.lost_fail_percent if unreached else np.inf
    if swung > config.swung_check_mm:  # what little is seen was brought there from far away
        lost_limit = min(lost_limit, config.lost_swung_fail_percent)
    share = 100.0 / max(len(analysis.faces), 1)
    flipped, cut = quality.numbers["flipped_faces"] * share, quality.numbers["self_intersections"] * share
    failed, check = [], []
    for name, value, doubtful, wrong, unit in (
        ("mean distance from scan to template", mean, config.check_mm + facets, config.fail_mm + facets, " mm"),
        ("95 % of the scan within", far, config.far_check_mm + facets, config.far_fail_mm + facets, " mm"),
        ("share of the scan beyond the template's borders", past, config.beyond_check_percent, np.inf, " %"),
        (
            "share of the template far from the scan",
            lost,
            config.lost_check_percent,
            lost_limit,
            " %",
        ),
        ("mean way beyond a rigid motion", swung, config.swung_check_mm, np.inf, " mm"),
        ("flipped faces", flipped, np.inf, config.flipped_fail_percent, " %"),
        ("self-intersecting faces", cut, np.inf, config.cut_fail_percent, " %"),
    ):
        factor = length_factor if unit == " mm" else 1.0
        if value > doubtful or value > wrong:
            limit = wrong if value > wrong else doubtful
            (failed if value > wrong else check).append(f"{name} {value * factor:.3g} > {limit * factor:.3g}{unit}")
    if failed or quality.verdict == "failed":
        return "failed", ((*quality.reasons,) if quality.verdict == "failed" else ()) + tuple(failed)
    if check or quality.verdict == "check":
        return "check", (*quality.reasons, *check)
    return "good", ()
