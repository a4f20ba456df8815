"""Trousers of four panels and a skirt of two, drafted for a body.

Draft coordinates: u from the body's middle, v the height in the rest pose, metres.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull

from capture4d.body.skinning import ShapedBody
from data_synth.cloth.panels import Edge, Panel, Pattern, bezier, lay_out, line

__all__ = ["skirt_pattern", "trousers_pattern"]

HIP_BELOW_ROOT_M, CROTCH_BELOW_ROOT_M = 0.05, 0.165
"""Where the hip is widest and where the legs part, below the root joint of the mean adult."""
FORK_M = {"front": 0.045, "back": 0.085}
"""How far each panel reaches over the middle, between the legs."""


def trousers_pattern(
    shaped: ShapedBody, *, size: float, ease: float, length: float, rise_m: float, hem_width: float
) -> Pattern:
    """Draft trousers: front and back of each leg, sewn at outseams, inseams and the centre front and back.

    Their legs stand as the person's do at rest, a little apart.

    Args:
        shaped: the person, in the rest pose.
        size: scale of the girths of waist and hip.
        ease: girth beyond the hip's, as a fraction of it.
        length: of the inseam, as a fraction of the way from the crotch to the ankle.
        rise_m: how far above the root joint the waistband lies.
        hem_width: of a leg, as a fraction of that at the crotch.
    """
    joint = dict(zip(shaped.body.joint_names, shaped.joints, strict=True))
    root_y = joint["root"][1]
    waist_y, hip_y, crotch_y = root_y + rise_m, root_y - HIP_BELOW_ROOT_M, root_y - CROTCH_BELOW_ROOT_M
    ankle_y = joint["foot.L"][1] + 0.03
    hem_y = crotch_y - (crotch_y - ankle_y) * length
    hip = _girth(shaped, hip_y) * size * (1 + ease) / 4
    waist = _girth(shaped, waist_y) * size / 4
    hip_joint, ankle = joint["upperleg01.L"], joint["foot.L"]
    lean = (ankle[0] - hip_joint[0]) / (hip_joint[1] - ankle[1]) * (crotch_y - hem_y)
    panels = []
    for name, fork in FORK_M.items():
        width, middle = hip + fork, (hip - fork) / 2
        hem = width * hem_width / 2
        crotch_out, crotch_in = (middle + width / 2, crotch_y), (-fork, crotch_y)
        hem_in, hem_out = (middle + lean - hem, hem_y), (middle + lean + hem, hem_y)
        outseam = np.concatenate(
            [
                line(hem_out, crotch_out)[:-1],
                bezier(crotch_out, (hip + 0.004, (hip_y + crotch_y) / 2), (hip, hip_y))[:-1],
                bezier((hip, hip_y), (hip, hip_y + 0.08), (waist, waist_y)),
            ]
        )
        centre = np.concatenate(
            [
                line((0.0, waist_y), (0.0, crotch_y + 0.09))[:-1],
                bezier((0.0, crotch_y + 0.09), (0.0, crotch_y + 0.005), crotch_in),
            ]
        )
        sides = (
            line(hem_in, hem_out),
            outseam,
            line((waist, waist_y), (0.0, waist_y)),
            centre,
            line(crotch_in, hem_in),
        )
        panels += [_leg_panel(name, side, sides) for side in ("left", "right")]
    return Pattern(lay_out(tuple(panels)), borders=("waist", "leg_left", "leg_right"))


def _leg_panel(name: str, side: str, sides: tuple[np.ndarray, ...]) -> Panel:
    """A leg's front or back as seen from outside, where the front of the left leg has its outseam on the +u side."""
    hem, outseam, waist, centre, inseam = sides
    edges = (
        Edge(hem, f"leg_{side}|{name}"),
        Edge(outseam, f"out_{side}"),
        Edge(waist, f"waist|{name}_{side}"),
        Edge(centre, f"centre_{name}"),
        Edge(inseam, f"in_{side}"),
    )
    if (name == "front") != (side == "left"):
        mirror = np.array([-1.0, 1.0])
        seams = ("out", "centre", "in")
        edges = tuple(
            Edge((edge.curve * mirror)[::-1], edge.name, reverse=edge.name.startswith(seams))
            for edge in (edges[0], *edges[:0:-1])
        )
    return Panel(f"{name}_{side}", edges)


def skirt_pattern(
    shaped: ShapedBody, *, size: float, ease: float, length_m: float, flare: float, rise_m: float
) -> Pattern:
    """Draft a skirt: front and back, sewn at the sides.

    Args:
        shaped: the person, in the rest pose.
        size: scale of the girths of waist and hip.
        ease: girth beyond the hip's, as a fraction of it.
        length_m: from the waist to the hem.
        flare: girth of the hem, as a multiple of the hip's.
        rise_m: how far above the root joint the waist lies.
    """
    root_y = shaped.joints[shaped.body.joint_names.index("root")][1]
    waist_y, hip_y = root_y + rise_m, root_y - HIP_BELOW_ROOT_M
    hem_y = waist_y - length_m
    waist = _girth(shaped, waist_y) * size / 4
    hip = _girth(shaped, hip_y) * size * (1 + ease) / 4
    hem, mirror = hip * flare, np.array([-1.0, 1.0])
    side = np.concatenate(
        [
            line((hem, hem_y + 0.03), (hip, hip_y))[:-1],
            bezier((hip, hip_y), (hip, hip_y + 0.1), (waist, waist_y)),
        ]
    )
    panels = []
    for name in ("front", "back"):
        plus, minus = ("left", "right") if name == "front" else ("right", "left")
        bottom = bezier((-hem, hem_y + 0.03), (-hem * 0.5, hem_y), (hem * 0.5, hem_y), (hem, hem_y + 0.03))
        top = bezier(
            (waist, waist_y), (waist * 0.5, waist_y - 0.012), (-waist * 0.5, waist_y - 0.012), (-waist, waist_y)
        )
        edges = (
            Edge(bottom, f"hem|{name}"),
            Edge(side, f"side_{plus}"),
            Edge(top, f"waist|{name}"),
            Edge((side * mirror)[::-1], f"side_{minus}", reverse=True),
        )
        panels.append(Panel(name, edges))
    return Pattern(lay_out(tuple(panels)), borders=("waist", "hem"))


def _girth(shaped: ShapedBody, height: float) -> float:
    """Perimeter, metres, of the convex hull of trunk and thighs at a height of the rest pose."""
    names = shaped.body.joint_names
    owners = np.argmax(shaped.body.skin_weights, axis=1)
    near = [i for i, name in enumerate(names) if name.startswith(("root", "spine", "pelvis", "upperleg"))]
    points = shaped.vertices[np.isin(owners, near) & (np.abs(shaped.vertices[:, 1] - height) < 0.015)]
    return float(ConvexHull(points[:, [0, 2]]).area)
