"""Shirts of front, back and two set-in sleeves, drafted for a body: a T-shirt, and one with long sleeves."""

from __future__ import annotations

import numpy as np
from scipy.optimize import root_scalar
from scipy.spatial import ConvexHull

from capture4d.body.skinning import ShapedBody
from data_synth.cloth.panels import Edge, Panel, Pattern, bezier, curve_length, lay_out, line
from data_synth.config import GarmentStyle

__all__ = ["shirt_pattern", "tshirt_pattern"]

TSHIRT_CUFF = 0.86
"""Width of the sleeve at the cuff, as a fraction of that at the underarm."""


def tshirt_pattern(shaped: ShapedBody, style: GarmentStyle) -> Pattern:
    """Draft a T-shirt for a body from its joints and chest girth.

    Args:
        shaped: the person, in the rest pose.
        style: size, sleeve length, ease and hem height.
    """
    joint = dict(zip(shaped.body.joint_names, shaped.joints, strict=True))
    arm_length = float(np.linalg.norm(joint["lowerarm01.L"] - joint["upperarm01.L"]))
    return shirt_pattern(
        shaped,
        size=style.size,
        ease=style.ease,
        hem_drop_m=style.hem_drop_m,
        sleeve_m=style.sleeve_length * arm_length,
        cuff=TSHIRT_CUFF,
    )


def shirt_pattern(
    shaped: ShapedBody, *, size: float, ease: float, hem_drop_m: float, sleeve_m: float, cuff: float
) -> Pattern:
    """Draft a shirt for a body from its joints and chest girth.

    Args:
        shaped: the person, in the rest pose.
        size: scale of the draft's widths; 1 fits the person before ease.
        ease: girth beyond the chest's, as a fraction of it.
        hem_drop_m: how far below the hip joint the hem lies.
        sleeve_m: underarm length of the sleeve.
        cuff: width of the sleeve at the cuff, as a fraction of that at the underarm.
    """
    joint = dict(zip(shaped.body.joint_names, shaped.joints, strict=True))
    half = _chest_girth(shaped) * size * (1 + ease) / 4
    shoulder = (abs(joint["upperarm01.L"][0]) + 0.012, joint["upperarm01.L"][1] + 0.045)
    underarm_y = shoulder[1] - size * (0.175 + 0.05 * ease)
    hem_y = joint["root"][1] - hem_drop_m
    neck = (0.082 * size, shoulder[1] + 0.035)
    armhole = _armhole(half, shoulder, underarm_y)
    panels = (
        _torso_panel("front", armhole, hem_y, neck, neck_depth=0.085),
        _torso_panel("back", armhole, hem_y, neck, neck_depth=0.022),
        *(_sleeve_panel(side, curve_length(armhole), sleeve_m, cuff) for side in ("left", "right")),
    )
    return Pattern(lay_out(panels), borders=("neck", "hem", "cuff_left", "cuff_right"))


def _chest_girth(shaped: ShapedBody) -> float:
    """Perimeter, metres, of the convex hull of the trunk's widest section between waist and armpit."""
    names = shaped.body.joint_names
    trunk = np.isin(
        np.argmax(shaped.body.skin_weights, axis=1),
        [i for i, name in enumerate(names) if name.startswith(("spine", "clavicle", "root"))],
    )
    height = shaped.joints[names.index("upperarm01.L")][1]
    points = shaped.vertices[trunk]
    girths = []
    for level in np.linspace(height - 0.25, height - 0.08, 8):
        section = points[np.abs(points[:, 1] - level) < 0.02]
        if len(section) > 8:
            girths.append(ConvexHull(section[:, [0, 2]]).area)
    return float(max(girths))


def _armhole(half: float, shoulder: tuple[float, float], underarm_y: float) -> np.ndarray:
    """From the underarm up to the shoulder tip, on the +u side."""
    inner = shoulder[0] - 0.012
    return bezier(
        (half, underarm_y), (inner + 0.02, underarm_y), (inner, underarm_y + 0.5 * (shoulder[1] - underarm_y)), shoulder
    )


def _torso_panel(
    name: str,
    armhole: np.ndarray,
    hem_y: float,
    neck: tuple[float, float],
    neck_depth: float,
) -> Panel:
    """Front or back as seen from outside: +u is the body's left on the front and its right on the back."""
    plus, minus = ("left", "right") if name == "front" else ("right", "left")
    half, underarm_y = armhole[0]
    mirror = np.array([-1.0, 1.0])
    side = line((half, hem_y), (half, underarm_y))
    shoulder = line(tuple(armhole[-1]), neck)
    low = neck[1] - neck_depth
    neckline = bezier(neck, (neck[0] * 0.9, low), (neck[0] * 0.3, low), (0, low))
    return Panel(
        name,
        (
            Edge(line((-half, hem_y), (half, hem_y)), f"hem|{name}"),
            Edge(side, f"side_{plus}"),
            Edge(armhole, f"armhole_{name}_{plus}"),
            Edge(shoulder, f"shoulder_{plus}"),
            Edge(np.concatenate([neckline, (neckline * mirror)[-2::-1]]), f"neck|{name}"),
            Edge((shoulder * mirror)[::-1], f"shoulder_{minus}", reverse=True),
            Edge((armhole * mirror)[::-1], f"armhole_{name}_{minus}", reverse=True),
            Edge((side * mirror)[::-1], f"side_{minus}", reverse=True),
        ),
    )


def _sleeve_panel(side: str, armhole_length: float, length: float, cuff_share: float) -> Panel:
    """A sleeve laid flat, cap up, cuff down, as seen from outside; each half of the cap is as long as an armhole."""
    plus, minus = ("back", "front") if side == "left" else ("front", "back")
    cap_height = 0.42 * armhole_length

    def cap(half_width: float) -> np.ndarray:
        return bezier(
            (half_width, 0), (0.62 * half_width, 0.05 * cap_height), (0.5 * half_width, cap_height), (0, cap_height)
        )

    bracket = (0.3 * armhole_length, armhole_length)
    half = float(root_scalar(lambda width: curve_length(cap(width)) - armhole_length, bracket=bracket).root)
    cuff = cuff_share * half
    mirror = np.array([-1.0, 1.0])
    seam = line((cuff, -length), (half, 0))
    return Panel(
        f"sleeve_{side}",
        (
            Edge(line((-cuff, -length), (cuff, -length)), f"cuff_{side}|sleeve"),
            Edge(seam, f"sleeve_{side}"),
            Edge(cap(half), f"armhole_{plus}_{side}"),
            Edge((cap(half) * mirror)[::-1], f"armhole_{minus}_{side}", reverse=True),
            Edge((seam * mirror)[::-1], f"sleeve_{side}", reverse=True),
        ),
    )
