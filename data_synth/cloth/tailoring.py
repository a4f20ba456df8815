"""Where a garment has more cloth than it needs, and how it was sewn: fields over its pattern, for any mesh of it.

A worn shirt lies calm over chest and shoulder blades and has too much cloth elsewhere, here more, there less. The
excess is a share of the cloth's size, across and along the grain: a calm zone of shirts or a waist, and patches of
log-normal noise.

Letters: V vertices, F faces; u across, v along the grain, metres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from capture4d.body.skinning import PosedBody
from data_synth.cloth.fabrics import Fabric
from data_synth.cloth.panels import Pattern
from data_synth.cloth.patterns import PanelMesh, smooth_noise
from data_synth.config import FoldConfig

__all__ = ["Made", "Sleeve", "Tailoring", "Wall", "bending_factors", "shrunk", "tailor", "wall_heights", "walls"]

PATCH_SEED = 5
"""Of the patches: one garment has them in one place on every mesh."""
PATCH_RANGE = (0.05, 4.0)
"""Least and most excess of a patch over the mean."""
CALM_FROM_M, CALM_TO_M = 0.16, 0.02
"""Below the underarm, between these, the calm zone of a shirt's front and back begins."""
CALM_ASIDE = (0.55, 0.95)
"""Shares of the half width between which it ends towards the sides."""
YOKE_M = (0.0, 0.06)
"""Above the underarm, between these, it widens to the armholes, and begins on the sleeves' caps."""
WAIST_M = (0.04, 0.14)
"""Below a waist, between these, trousers and skirts begin to fold: a waistband has no more cloth than it needs."""
WALL_LEANS, WALL_RETREAT_M = (0.45, 0.75), 0.15
"""Between these sines of an arm's angle out of the body's frontal plane its wall gives way, by this at most: an arm
that points forwards has the chest on its own side."""
SLEEVE_SIDE = 0.3
"""Share of the half width beyond which front and back can meet the sleeve."""


@dataclass(frozen=True, slots=True, eq=False)
class Sleeve:
    """A sleeve and the side of the trunk that it hangs beside: what must not pass through each other."""

    side: str
    """L or R, as the body's joints are named."""
    underarm: int
    """Vertex where side seam and sleeve seam meet."""
    rows: np.ndarray
    """(n,) vertices of both."""
    signs: np.ndarray
    """(n,) 1 on the sleeve, -1 on the trunk."""


@dataclass(frozen=True, slots=True, eq=False)
class Tailoring:
    """What the making of a garment gives one mesh of it."""

    scale: np.ndarray
    """(F, 1, 2) size, across and along the grain, that leaves the excess over."""
    strip: np.ndarray
    """(V,) bool: the turned layer along every border."""
    sleeves: tuple[Sleeve, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Made:
    """A mesh's tailoring and the settings it follows from."""

    tailoring: Tailoring
    folds: FoldConfig


@dataclass(frozen=True, slots=True, eq=False)
class Wall:
    """The plane between an arm and the trunk in one pose; it passes through the underarm."""

    normal: np.ndarray
    """(3,) towards the arm."""
    along: np.ndarray
    """(3,) away from the shoulder, half-way between arm and trunk."""
    retreat: float = 0.0
    """How far the plane has given way to both, metres."""


def tailor(mesh: PanelMesh, pattern: Pattern, folds: FoldConfig) -> Tailoring:
    """The excess cloth, hems and sleeves of a garment on one of its meshes."""
    calm = _calm(mesh, pattern)
    noise = smooth_noise(mesh.noise_uv, 1.0, folds.patch_width_m, np.random.default_rng(PATCH_SEED)).astype(np.float64)
    patches = np.clip(np.exp(folds.patch_spread * (noise - noise.mean()) / noise.std()), *PATCH_RANGE)
    patches = (patches / patches.mean())[mesh.faces].mean(axis=1)
    excess = (1 - calm[:, None]) * (1 - np.array(folds.shrink)) + calm[:, None] * (1 - np.array(folds.calm_shrink))
    excess[:, 0] = np.minimum(excess[:, 0] * patches, folds.most_excess)
    border = np.concatenate(list(mesh.loops.values()))
    strip = KDTree(mesh.uv[np.isin(mesh.faces, border)]).query(mesh.vertex_uv)[0] < folds.strip_m
    return Tailoring(1 - excess[:, None], strip, _sleeves(mesh, pattern))


def shrunk(mesh: PanelMesh, scale: np.ndarray, share: float = 1.0) -> PanelMesh:
    """The mesh on a pattern without a share of the excess that a scale, (F, 1, 2), leaves over."""
    return replace(mesh, uv=mesh.uv * (1 - share * (1 - scale)))


def bending_factors(mesh: PanelMesh, made: Made, fabric: Fabric, edges: np.ndarray) -> np.ndarray:
    """How much stiffer cloth bends about some inner edges, (E, 2), than one layer of it does across its grain, (E,).

    Turned layers and seams are stiffer, and cloth bent along its grain, about edges across it, by the fabric's ratio.
    """
    direction = mesh.vertex_uv[edges[:, 1]] - mesh.vertex_uv[edges[:, 0]]
    across = direction[:, 0] ** 2 / np.maximum((direction**2).sum(axis=1), 1e-18)
    factors = 1 + (fabric.grain_bending - 1) * across
    for seam in mesh.seams.values():
        factors[np.isin(edges, seam).all(axis=1)] = made.folds.seam_bending
    factors[made.tailoring.strip[edges].all(axis=1)] *= made.folds.strip_bending
    return factors


def walls(sleeves: tuple[Sleeve, ...], body: PosedBody) -> tuple[Wall, ...]:
    """Where each arm of a posed body parts from the trunk: the plane that halves the angle between them."""
    if not sleeves:
        return ()
    names, centres = body.shaped.body.joint_names, body.joint_centres()
    found = []
    down = _unit(centres[names.index("root")] - centres[names.index("neck01")])
    aside = _unit(centres[names.index("upperarm01.L")] - centres[names.index("upperarm01.R")])
    for sleeve in sleeves:
        shoulder, elbow = (centres[names.index(f"{bone}.{sleeve.side}")] for bone in ("upperarm01", "lowerarm01"))
        arm = _unit(elbow - shoulder)
        outwards = 0.1 * aside if sleeve.side == "L" else -0.1 * aside  # an arm along the trunk still has a side
        leans = np.abs([arm @ _unit(np.cross(down, aside))])
        retreat = WALL_RETREAT_M * float(_smooth_step(leans, *WALL_LEANS)[0])
        found.append(Wall(_unit(arm - down + outwards), _unit(arm + down + outwards), retreat))
    return tuple(found)


def wall_heights(points: np.ndarray, sleeve: Sleeve, wall: Wall) -> tuple[np.ndarray, np.ndarray]:
    """How far the sleeve's `rows` of some points, (V, 3), are on their own side of the wall, and how far below the
    underarm, both (n,) metres; above the underarm there is no wall."""
    from_underarm = points[sleeve.rows] - points[sleeve.underarm]
    return sleeve.signs * (from_underarm @ wall.normal) + wall.retreat, from_underarm @ wall.along


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def _draft(mesh: PanelMesh, pattern: Pattern, uv: np.ndarray, panels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where points lie on a shirt's front or back: u over the half width, and v over the underarm, metres."""
    front = next(panel for panel in pattern.panels if panel.name == "front")
    armhole = next(edge for edge in front.edges if edge.name == "armhole_front_left")
    half, underarm = armhole.curve[0] - front.origin
    draft = uv - np.array([panel.origin for panel in pattern.panels])[panels]
    return draft[:, 0] / half, draft[:, 1] - underarm


def _calm(mesh: PanelMesh, pattern: Pattern) -> np.ndarray:
    """(F,) 1 where a shirt lies calm: chest, shoulder blades, yoke, sleeve caps; at a waist; 0 elsewhere."""
    names, middle = [panel.name for panel in pattern.panels], mesh.uv.mean(axis=1)
    if "waist" in mesh.loops:
        from_waist = KDTree(mesh.uv[np.isin(mesh.faces, mesh.loops["waist"])]).query(middle)[0]
        return 1 - _smooth_step(from_waist, *WAIST_M)
    if not {"front", "back", "sleeve_left"} <= set(names):
        return np.zeros(len(mesh.faces))
    panels = np.array(names)[mesh.face_panels]
    u, v = _draft(mesh, pattern, middle, mesh.face_panels)
    over_underarm = _smooth_step(v, *YOKE_M)
    aside = (1 - over_underarm) * _smooth_step(np.abs(u), *CALM_ASIDE)
    on_trunk = _smooth_step(v, -CALM_FROM_M, -CALM_TO_M) * (1 - aside)
    origins = np.array([panel.origin[1] for panel in pattern.panels])
    on_sleeve = _smooth_step(middle[:, 1] - origins[mesh.face_panels], *YOKE_M)
    return np.where(np.isin(panels, ("front", "back")), on_trunk, on_sleeve)


def _smooth_step(x: np.ndarray, low: float, high: float) -> np.ndarray:
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def _sleeves(mesh: PanelMesh, pattern: Pattern) -> tuple[Sleeve, ...]:
    names = np.array([panel.name for panel in pattern.panels])
    found = []
    vertex_panels = mesh.face_panels[mesh.vertex_faces]
    for side, sign in (("left", 1), ("right", -1)):
        if f"sleeve_{side}" not in names:
            continue
        (underarm,) = np.intersect1d(mesh.seams[f"side_{side}"], mesh.seams[f"sleeve_{side}"])
        u, v = _draft(mesh, pattern, mesh.vertex_uv, vertex_panels)
        panel = names[vertex_panels]
        outer = np.where(panel == "front", sign, -sign) * u > SLEEVE_SIDE
        trunk = np.flatnonzero(np.isin(panel, ("front", "back")) & outer & (v < 0))
        origin = next(each.origin for each in pattern.panels if each.name == f"sleeve_{side}")
        sleeve = np.flatnonzero((panel == f"sleeve_{side}") & (mesh.vertex_uv[:, 1] - origin[1] < 0))
        rows = np.concatenate([sleeve, trunk])
        signs = np.repeat([1.0, -1.0], [len(sleeve), len(trunk)])
        found.append(Sleeve(side[0].upper(), int(underarm), rows, signs))
    return tuple(found)
