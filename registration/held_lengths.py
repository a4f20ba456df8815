"""Cloth that has folded on its way: no shape of it is left, but all its lengths.

What settles is held to the shape that it has at rest, which folded cloth has not; and what is pushed to the nearest
planes alone stays where it came to lie along the surface, stretched here and shortened there. Cloth hardly stretches.
So here lengths along edges are held as strongly at the end as at the start, and bending not at all: the template
slides on the scan until its lengths fit, from a hand's breadth away.

What cannot be brought to its scan in this way is no cloth, or another's, and stays as it was.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from registration.config import RegistrationConfig, Schedule
from registration.energies import edge_vectors
from registration.register import FrameScan, register_frame
from registration.scan_noise import held_against_noise
from registration.template import TemplateAnalysis

__all__ = ["keeps_lengths", "slid"]

SLIDING = Schedule(30, (0.06, 0.012), smooth=(0.2, 0.02), stretch=(10.0, 10.0), boundary=(0.3, 0.05))
"""All bending is forgiven from step to step; its weight keeps neighbours together on their way."""
LAST_STRETCH = (10.0, 1.0)
"""Of the dense stage that ends it: what little the cloth has stretched."""
LEAST, MOST = 0.95, 1.05
"""Of edges over the template's, at 1 and at 99 %."""


def slid(
    analysis: TemplateAnalysis,
    scan: FrameScan,
    vertices: Float64[np.ndarray, "verts 3"],
    config: RegistrationConfig,
    roughness: tuple[float, float],
) -> Float64[np.ndarray, "verts 3"]:
    """The template on the scan with its lengths, however it bends for it.

    Args:
        vertices: where it lies, metres.
        config: how scan points are matched, and the dense stage that ends it; no coarse stage.
        roughness: of the scan and of the template, metres.
    """
    loose = replace(config.dense, cold=SLIDING, plasticity=1.0)
    there = register_frame(analysis, scan, vertices, config=replace(config, dense=loose)).vertices
    held = replace(config.dense.cold, stretch=LAST_STRETCH)
    last = held_against_noise(replace(config, dense=replace(config.dense, cold=held)), *roughness)
    return register_frame(analysis, scan, there, config=last).vertices


def keeps_lengths(analysis: TemplateAnalysis, vertices: Float64[np.ndarray, "verts 3"]) -> bool:
    """Whether edges are about as long as the template's, all but the few that a fold's line shortens."""
    now = np.linalg.norm(edge_vectors(vertices, analysis.edges), axis=1)
    least, most = np.percentile(now / analysis.rest_lengths, (1, 99))
    return bool(least >= LEAST and most <= MOST)
