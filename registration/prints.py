"""What is printed on a template: learned from registered frames, or read from a picture over its UVs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, UInt8

from capture4d.mesh_files.textures import sampled
from registration.colour_term import ClothColours, ColourSamples, SeenColours, log_colours, sample_template, see_colours, without_light
from registration.register import FrameScan
from registration.template import TemplateAnalysis

LEVELS = ((0.014, 0.015), (0.007, 0.0065))
"""Distance of samples, and reach of the blur, metres."""


def statistics(analysis, samples, values, gradients, known):
    about = without_light(analysis, samples, values, known.astype(float))
    square = (about**2).sum(1)[known]
    steep = (gradients**2).sum((1, 2))[known] / 2
    return float(np.sqrt((steep**2).sum() / steep.sum())), float((square**2).sum() / square.sum())


def average(analysis, frames, levels=LEVELS, ref=None):
    out = []
    for li, (spacing, reach) in enumerate(levels):
        samples = sample_template(analysis, spacing) if ref is None else ref[li].samples
        base = None if ref is None else ref[li].values
        bk = None if ref is None else ref[li].known
        total, count = np.zeros((len(samples), 3)), np.zeros(len(samples))
        for scan, vertices in frames:
            seen = see_colours(scan.surface, scan.colours, samples, vertices, reach)
            if base is None:
                base, bk = seen.values, seen.known
            both = seen.known & bk
            aligned = base + without_light(analysis, samples, seen.values - base, both.astype(float))
            total[seen.known] += aligned[seen.known]
            count[seen.known] += 1
        steep, spread = statistics(analysis, samples, seen.values, seen.gradients, seen.known)
        out.append(ClothColours(samples, reach, total / np.maximum(count, 1)[:, None], count > 0, steep, spread))
    return tuple(out)
