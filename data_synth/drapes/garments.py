"""The kinds of garments: how each is cut, hung around the body, which of its parts it meets, and where it is held."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from capture4d.body.skinning import PosedBody, ShapedBody
from capture4d.errors import InputError
from capture4d.geometry.ray_casting import TriangleScene
from data_synth.cloth.bottoms import CROTCH_BELOW_ROOT_M, skirt_pattern, trousers_pattern
from data_synth.cloth.necktie import necktie_pattern
from data_synth.cloth.panels import Panel, Pattern
from data_synth.cloth.patterns import PanelMesh
from data_synth.cloth.simulation import dressing_rotations
from data_synth.cloth.tshirt import shirt_pattern, tshirt_pattern
from data_synth.drapes.config import STYLES, GarmentName, Style

__all__ = ["GARMENTS", "PINNED_M", "Garment", "Placement", "panel_vertices", "parse_style", "style_values"]

SIDES = (("left", "L", 1.0), ("right", "R", -1.0))
ARM_SHARE = 0.2
"""Skin weight of arm, shoulder and collar bone from which skin is of the arm's part: a sleeve meets nothing else, and
at 0.35 the shoulder showed in front of its cap."""
PINNED_M = 0.012
"""Of a garment that is pinned, what is nearer to its upper end is fixed to the skin."""
ASPECT = 0.75
"""Depth of the trunk over its width, of the ellipse on which bottoms are hung."""


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """A garment's panels where each belongs on a body in the dressing pose, not yet at rest."""

    panels: np.ndarray
    """(V,) name of each vertex's panel."""
    draft: np.ndarray
    """(V, 2) its place in the draft: u from the middle of panel or body, v along the grain; metres."""
    pattern: Pattern


@dataclass(frozen=True, slots=True)
class Garment:
    """One kind of garment."""

    draft: Callable[[ShapedBody, Any], Pattern]
    """Its pattern for a person, in a style."""
    dressing: Callable[[ShapedBody], np.ndarray]
    """Joint rotations, (J, 3, 3), in which it is put on."""
    hang: Callable[[Placement, PosedBody], np.ndarray] | None
    """Vertices (V, 3) around a body in the dressing pose; None for shirts, which the moving simulator puts on."""
    parts: Callable[[ShapedBody], np.ndarray]
    """(P, B) bool: the body's vertices in each part that it meets."""
    meets: Mapping[str, tuple[int, ...]]
    """Parts that a panel meets, by its name."""
    seam: int
    """The part that vertices meet on a seam between panels that meet different ones."""
    held_from: Callable[[ShapedBody, np.ndarray, PanelMesh], float]
    """Height in the rest pose below which it is held less, from the garment's vertices at rest."""
    limbs: tuple[str, ...]
    """What moves it: "spine", "arms", "legs"."""
    pinned: bool = False
    """Whether its top rows are fixed to the skin."""


def parse_style(garment: GarmentName, given: tuple[str, ...]) -> Style:
    """The style that NAME=VALUE texts say.

    Raises:
        InputError: another garment's, or a value out of range.
    """
    kind, values = STYLES[garment], {}
    known = [each.name for each in fields(kind)]
    for text in given:
        name, sign, value = text.partition("=")
        if not sign or name not in known:
            raise InputError(f"--style: expected NAME=VALUE, of a {garment} {', '.join(known)}; found {text!r}")
        try:
            values[name] = float(value)
        except ValueError:
            raise InputError(f"--style {name}: expected a number, found {value!r}") from None
    return kind(**values)


def style_values(style: Style) -> dict[str, float]:
    """A style as numbers, in the order of its fields."""
    return {each.name: float(getattr(style, each.name)) for each in fields(style)}


def panel_vertices(mesh: PanelMesh, pattern: Pattern) -> tuple[np.ndarray, np.ndarray]:
    """Name of each vertex's panel, (V,), and its place in the draft, (V, 2)."""
    own = mesh.face_panels[mesh.vertex_faces]
    names, origins = zip(*((panel.name, panel.origin) for panel in pattern.panels), strict=True)
    return np.array(names)[own], mesh.vertex_uv - np.array(origins)[own]


# --- poses in which garments are put on --------------------------------------------------------------------------


def _straight_arms(person: ShapedBody) -> np.ndarray:
    """Arms held out sideways with straight elbows: forearms that bend would lie outside a straight sleeve."""
    rotations = dressing_rotations(person)
    names = person.body.joint_names
    joint = dict(zip(names, person.joints, strict=True))
    for _, side, sign in SIDES:
        upper = joint[f"lowerarm01.{side}"] - joint[f"upperarm01.{side}"]
        fore = joint[f"wrist.{side}"] - joint[f"lowerarm01.{side}"]
        upper, fore = upper / np.linalg.norm(upper), fore / np.linalg.norm(fore)
        turned = Rotation.align_vectors([[sign, 0.0, 0.0]], upper[None])[0]
        rotations[names.index(f"upperarm01.{side}")] = turned.as_matrix()
        bent = Rotation.align_vectors(upper[None], fore[None])[0]
        rotations[names.index(f"lowerarm01.{side}")] = bent.as_matrix()
    return rotations


def _as_at_rest(person: ShapedBody) -> np.ndarray:
    return np.repeat(np.eye(3)[None], len(person.body.joint_names), axis=0)


# --- parts of the body -------------------------------------------------------------------------------------------


def _share(person: ShapedBody, *starts: str, side: str = "") -> np.ndarray:
    """Skin weight, (B,), of the joints whose names begin so, of one side or both."""
    names = person.body.joint_names
    chosen = [i for i, name in enumerate(names) if name.startswith(starts) and name.endswith(side)]
    return person.body.skin_weights[:, chosen].sum(axis=1)


def _trunk_and_arms(person: ShapedBody) -> np.ndarray:
    """The trunk down to the thighs, and either arm with its shoulder; they overlap."""
    low = person.vertices[:, 1] < person.joints[person.body.joint_names.index("upperleg01.L")][1] - 0.35
    upper_arms = [_share(person, "upperarm", "lowerarm", "wrist", side=side) for _, side, _ in SIDES]
    trunk = (np.max(upper_arms, axis=0) < 0.6) & ~low & (_share(person, "head") < 0.5)
    arms = [
        (_share(person, "clavicle", "shoulder", "upperarm", "lowerarm", "wrist", side=side) > ARM_SHARE)
        for _, side, _ in SIDES
    ]
    return np.stack([trunk, *arms])


def _trunk_and_legs(person: ShapedBody) -> np.ndarray:
    """The lower trunk with the left leg, with the right, and with both."""
    names = person.body.joint_names
    chest = person.joints[names.index("spine02")][1]
    trunk = (person.vertices[:, 1] < chest) & (_share(person, "upperarm", "lowerarm", "wrist") < 0.3)
    other = [_share(person, "upperleg", "lowerleg", "foot", side=side) for side in ("R", "L")]
    return np.stack([*(trunk & (share < 0.5) for share in other), trunk])


def _trunk(person: ShapedBody) -> np.ndarray:
    """Neck and trunk down to the knees, without arms."""
    low = person.vertices[:, 1] < person.joints[person.body.joint_names.index("upperleg01.L")][1] - 0.5
    return ((_share(person, "upperarm", "lowerarm", "wrist") < 0.4) & ~low)[None]


# --- hanging around the body -------------------------------------------------------------------------------------


def _hang_trousers(placed: Placement, body: PosedBody) -> np.ndarray:
    """Tubes around the legs, that become half an ellipse around the trunk above where the legs part."""
    joint = dict(zip(body.shaped.body.joint_names, body.joint_centres(), strict=True))
    root = joint["root"]
    panels = {panel.name: panel for panel in placed.pattern.panels}
    crotch = root[1] - CROTCH_BELOW_ROOT_M
    points = np.empty((len(placed.draft), 3))
    for word, side, sign in SIDES:
        extents = {name: _Extent.of(panels[f"{name}_{word}"]) for name in ("front", "back")}
        leg = np.array([joint[f"{name}.{side}"] for name in ("foot", "lowerleg01", "upperleg01")])
        for name, towards in (("front", 1.0), ("back", -1.0)):
            rows = placed.panels == f"{name}_{word}"
            u, v = placed.draft[rows].T
            outwards = u * extents[name].sign
            inner, outer = extents[name].at(v)
            share = np.clip((outwards - inner) / np.maximum(outer - inner, 1e-6), 0, 1)
            widths = sum(np.subtract(*each.at(v)[::-1]) for each in extents.values())
            centre = np.stack([np.interp(v, leg[:, 1], leg[:, axis]) for axis in (0, 2)], axis=1)
            radius = widths / (2 * np.pi)
            tube_x = centre[:, 0] - sign * np.cos(np.pi * share) * radius
            tube_z = centre[:, 1] + towards * np.sin(np.pi * share) * radius
            half = widths / np.pi / np.sqrt((1 + ASPECT**2) / 2)
            trunk_x = sign * half * np.sin(np.pi / 2 * share)
            trunk_z = root[2] + towards * ASPECT * half * np.cos(np.pi / 2 * share)
            blend = np.clip((v - crotch) / 0.09, 0, 1)
            blend = blend * blend * (3 - 2 * blend)
            x = (1 - blend) * tube_x + blend * trunk_x
            on_middle = (share < 1e-6) & (v > crotch - 1e-6)
            x = np.where(on_middle, 0.0, sign * np.maximum(sign * x, 0.002))
            points[rows] = np.column_stack([x, v, (1 - blend) * tube_z + blend * trunk_z])
    return points


def _hang_skirt(placed: Placement, body: PosedBody) -> np.ndarray:
    """An ellipse around the body at every height."""
    root = body.joint_centres()[body.shaped.body.joint_names.index("root")]
    panels = {panel.name: panel for panel in placed.pattern.panels}
    points = np.empty((len(placed.draft), 3))
    for name, towards in (("front", 1.0), ("back", -1.0)):
        rows = placed.panels == name
        u, v = placed.draft[rows].T
        outline = np.concatenate([edge.curve for edge in panels[name].edges if edge.name.startswith("side")])
        outline = outline - panels[name].origin
        outline = outline[np.argsort(outline[:, 1])]
        width = np.interp(v, outline[:, 1], np.abs(outline[:, 0]))
        angle = np.pi / 2 * np.clip(u / width, -1, 1)
        half = 2 * width / np.pi / np.sqrt((1 + ASPECT**2) / 2)
        points[rows] = np.column_stack(
            [towards * half * np.sin(angle), v, root[2] + towards * ASPECT * half * np.cos(angle)]
        )
    return points


def _hang_necktie(placed: Placement, body: PosedBody) -> np.ndarray:
    """A straight strip in front of the trunk."""
    scene = TriangleScene((body.vertices(), body.shaped.body.template.faces))
    u, v = placed.draft.T
    rays = np.column_stack([u, v, np.ones(len(u)), np.zeros((len(u), 2)), -np.ones(len(u))])
    skin = 1 - scene.cast(rays).distance
    levels = np.sort(np.unique(v))[::-1]
    front = np.array([skin[np.abs(v - level) < 0.02].max() for level in levels])
    front[levels > levels[0] - PINNED_M] = front[levels > levels[0] - PINNED_M].max()
    outermost = np.maximum.accumulate(front) + 0.008  # what hangs does not follow the belly back in
    return np.column_stack([u, v, np.interp(v, levels[::-1], outermost[::-1])])


@dataclass(frozen=True, slots=True, eq=False)
class _Extent:
    """From where to where a panel of trousers reaches at each height, measured away from the body's middle."""

    inner: np.ndarray
    outer: np.ndarray
    sign: float

    @staticmethod
    def of(panel: Panel) -> _Extent:
        curves = {
            kind: np.concatenate([edge.curve for edge in panel.edges if edge.name.startswith(kind)]) - panel.origin
            for kind in (("in", "centre"), ("out",))
        }
        inner, outer = curves["in", "centre"], curves["out",]
        sign = float(np.sign(outer[:, 0].mean()))
        inner, outer = (curve[np.argsort(curve[:, 1])] * (sign, 1.0) for curve in (inner, outer))
        return _Extent(inner, outer, sign)

    def at(self, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.interp(v, *self.inner.T[::-1]), np.interp(v, *self.outer.T[::-1])


# --- where they are held -----------------------------------------------------------------------------------------


def _at_shoulders(person: ShapedBody, rest: np.ndarray, mesh: PanelMesh) -> float:
    return float(person.joints[person.body.joint_names.index("upperarm01.L")][1])


def _at_waist(person: ShapedBody, rest: np.ndarray, mesh: PanelMesh) -> float:
    return float(rest[mesh.loops["waist"], 1].mean())


def _at_top(person: ShapedBody, rest: np.ndarray, mesh: PanelMesh) -> float:
    return float(rest[:, 1].max())


def _shirt_draft(person: ShapedBody, style: Any) -> Pattern:
    joint = dict(zip(person.body.joint_names, person.joints, strict=True))
    arm = [joint[f"{name}.L"] for name in ("upperarm01", "lowerarm01", "wrist")]
    length = float(np.linalg.norm(np.diff(arm, axis=0), axis=1).sum())
    return shirt_pattern(
        person,
        size=style.size,
        ease=style.ease,
        hem_drop_m=style.hem_drop_m,
        sleeve_m=style.sleeve_length * length,
        cuff=style.cuff_width,
    )


_SLEEVED = {"front": (0,), "back": (0,), "sleeve_left": (1,), "sleeve_right": (2,)}
GARMENTS: Mapping[GarmentName, Garment] = {
    "tshirt": Garment(
        tshirt_pattern, dressing_rotations, None, _trunk_and_arms, _SLEEVED, 0, _at_shoulders, ("spine", "arms")
    ),
    "shirt": Garment(
        _shirt_draft, _straight_arms, None, _trunk_and_arms, _SLEEVED, 0, _at_shoulders, ("spine", "arms")
    ),
    "trousers": Garment(
        lambda person, style: trousers_pattern(person, **style_values(style)),
        _as_at_rest,
        _hang_trousers,
        _trunk_and_legs,
        {"front_left": (0,), "back_left": (0,), "front_right": (1,), "back_right": (1,)},
        2,
        _at_waist,
        ("spine", "legs"),
    ),
    "skirt": Garment(
        lambda person, style: skirt_pattern(person, **style_values(style)),
        _as_at_rest,
        _hang_skirt,
        lambda person: _trunk_and_legs(person)[2:],
        {"front": (0,), "back": (0,)},
        0,
        _at_waist,
        ("spine", "legs"),
    ),
    "necktie": Garment(
        lambda person, style: necktie_pattern(person, **style_values(style)),
        _as_at_rest,
        _hang_necktie,
        _trunk,
        {"front": (0,)},
        0,
        _at_top,
        ("spine",),
        pinned=True,
    ),
}
"""By name."""
