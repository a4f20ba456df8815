"""The blade of a necktie: one panel that hangs from the knot; collar and knot are left out."""

from __future__ import annotations

import numpy as np

from capture4d.body.skinning import ShapedBody
from data_synth.cloth.panels import Edge, Panel, Pattern, lay_out, line

__all__ = ["necktie_pattern"]

KNOT_BELOW_NECK_M = 0.035
"""The hollow of the throat, where the knot lies, below the lowest joint of the neck."""
KNOT_WIDTH_SHARE, WIDEST_AT = 0.38, 0.86
"""Width at the knot, as a share of the widest; where the blade is widest, as a share of its length."""


def necktie_pattern(shaped: ShapedBody, *, length_m: float, width_m: float) -> Pattern:
    """Draft a blade that widens from the knot and ends in a point.

    Args:
        shaped: the person, in the rest pose: only where the knot lies.
        length_m: from the knot to the tip.
        width_m: at the widest.
    """
    knot_y = shaped.joints[shaped.body.joint_names.index("neck01")][1] - KNOT_BELOW_NECK_M
    knot, wide, mirror = KNOT_WIDTH_SHARE * width_m / 2, width_m / 2, np.array([-1.0, 1.0])
    widest_y, tip_y = knot_y - WIDEST_AT * length_m, knot_y - length_m
    tip = line((0.0, tip_y), (wide, widest_y))
    side = line((wide, widest_y), (knot, knot_y))
    edges = (
        Edge(np.concatenate([(tip * mirror)[::-1], tip[1:]]), "outline|tip"),
        Edge(side, "outline|left"),
        Edge(line((knot, knot_y), (-knot, knot_y)), "outline|knot"),
        Edge((side * mirror)[::-1], "outline|right"),
    )
    return Pattern(lay_out((Panel("front", edges),)), borders=("outline",))
