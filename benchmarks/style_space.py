"""Spaces of styles: whether two rounds of draping find the same components, and whether every style can be worn.

Wanted: cosines of the principal angles between the rounds' components at least 0.97 for the first three; of styles at
random within 1.5 sigma at least 95 % without a crushed or overstretched face, and at most 0.1 % of vertices inside the
body. The paper shows its two components in a figure and prints no figures (TailorNet, section 5.1).
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

import numpy as np

from benchmarks.metric import Metric
from capture4d.body.anny import load_anny
from data_synth.drapes.config import DrapesConfig
from data_synth.drapes.draping import Draper
from data_synth.drapes.quality import face_area_ratios, measure_drape
from data_synth.styles.config import STYLE_SETS
from data_synth.styles.pairs import ranges_of
from data_synth.styles.style_space import LIMIT, subspace_cosines, two_rounds

AREAS = (0.25, 2.0)
"""Of a face over that on the pattern, beyond which it is crushed or overstretched (Jin et al., section 5)."""


def run(*, quick: bool = False, seed: int = 3, vertices: int = 1200, styles: int = 200) -> list[Metric]:
    """Find the style spaces of a T-shirt and a skirt, and drape styles at random.

    Args:
        quick: a skirt of 300 vertices in few styles.
        vertices: of each garment's mesh.
        styles: at random, of each garment.
    """
    if quick:
        return _measured("tiny-style-space", seed, vertices=300, styles=12)
    presets = "tshirt-style-space", "tiny-style-space"
    return [each for preset in presets for each in _measured(preset, seed, vertices=vertices, styles=styles)]


def _measured(preset: str, seed: int, *, vertices: int, styles: int) -> list[Metric]:
    config, body, begun = STYLE_SETS[preset], load_anny(), time.process_time()
    still = np.repeat(np.eye(3)[None], len(body.joint_names), axis=0)
    rng = np.random.default_rng(seed)

    def draper(cut: Mapping[str, float]) -> Draper:
        texts = tuple(f"{name}={value!r}" for name, value in cut.items())
        return Draper(DrapesConfig(garment=config.garment, style=texts, vertices=vertices), body)

    def drape(cuts: Sequence[Mapping[str, float]]) -> np.ndarray:
        return np.stack([draper(cut).drape(still).vertices for cut in cuts])

    first, space = two_rounds(ranges_of(config)[0], config.drawn, rng, drape)
    cosines = subspace_cosines(first.directions, space.directions)
    inside, whole = [], []
    for gamma in rng.uniform(-LIMIT, LIMIT, (styles, len(space.names))):
        worn = draper(space.cut(gamma))
        found = worn.drape(still)
        quality, _ = measure_drape(worn, still, found)
        areas = face_area_ratios(worn, found.vertices)
        inside.append(quality.inside_percent)
        whole.append(areas.min() >= AREAS[0] and areas.max() <= AREAS[1])
    found_metrics = [
        *(Metric(f"cosine_{k}", float(cosine), "", "higher") for k, cosine in enumerate(cosines, 1)),
        Metric("two_components_explain", float(space.explained[:2].sum()), "", "higher"),
        Metric("whole_percent", 100 * float(np.mean(whole)), "%", "higher"),
        Metric("inside_percent", float(np.mean(inside)), "%"),
        Metric("cpu_s", time.process_time() - begun, "s"),
    ]
    return [Metric(f"{config.garment}_{each.key}", each.value, each.unit, each.better) for each in found_metrics]
