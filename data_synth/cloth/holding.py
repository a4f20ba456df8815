"""What keeps a simulated sheet in its seat: springs to where it was put on, and planes between sleeves and trunk.

Letters: V vertices of the sheet, J joints. Metres, newtons, world frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture4d.body.binding import WEIGHT_SMOOTHING, bind
from capture4d.body.skinning import PosedBody, skin, unskin
from capture4d.geometry.mesh import vertex_adjacency, vertex_normals
from data_synth.cloth.patterns import PanelMesh, smooth_noise
from data_synth.cloth.tailoring import Made, Sleeve, Wall, wall_heights, walls
from data_synth.config import SimulationConfig

__all__ = ["Hold", "Walls"]

ARM_SIDES, ARM_BONES = (".L", ".R"), ("upperarm", "lowerarm")
"""Of the body's joints."""
WALL_MARGIN_M = 0.005
"""Room that sleeve and trunk keep to the plane between them, for the folds of both."""
WALL_OPENING = 0.125
"""How fast that room grows from the underarm downwards."""


@dataclass(frozen=True, slots=True, eq=False)
class Hold:
    """Soft springs from the cloth to where it sat on the body when it was put on.

    They stand for what keeps a worn shirt in place, the seams and the stiffness of the yoke, and they are why a take
    depends on the pose and hardly on how it was reached: where friction lets the cloth stick, and where it buckles
    when the arms go up, a free sheet has as many answers as histories. The places are bumpy, always in the same way,
    and so decide how the cloth buckles.
    """

    rest: np.ndarray
    """(V, 3) in the body's rest pose, metres."""
    skin_weights: np.ndarray
    """(V, J)."""
    stiffness: np.ndarray
    """(V, 1) spring constants, N/m."""
    limbs: np.ndarray
    """(V, 3) how freely each vertex goes along the left arm, the right arm, and the trunk, 0 to 1."""

    @staticmethod
    def take(
        mesh: PanelMesh,
        cloth: np.ndarray,
        body: PosedBody,
        masses: np.ndarray,
        config: SimulationConfig,
        *,
        made: Made | None,
        held_from: float | None,
    ) -> Hold:
        """Hold the cloth, (V, 3) with limbs well apart, where it is on the body now; firmest at the shoulders, or from
        another height upwards.

        Args:
            made: how the garment was made; None: the hold follows the skin beneath it as it is.
            held_from: that height in the rest pose, metres; None: that of the shoulders.
        """
        # Diffused over a coarse sheet, weights would let the thighs turn a waistband.
        at_waist = held_from is not None
        _, _, weights = bind(cloth, mesh.faces, body, smoothing=0 if at_waist else WEIGHT_SMOOTHING)
        adjacency = vertex_adjacency(mesh.faces, mesh.vertex_count).astype(np.float64)
        around = np.asarray(adjacency.sum(axis=1)).reshape(-1, 1)
        for _ in range(0 if made is None or at_waist else made.folds.hold_spread):
            weights = 0.5 * weights + 0.5 * (adjacency @ weights) / around
        rest, flagged = unskin(cloth, weights, body.transforms)
        assert not flagged.any(), "the dressing pose cannot be unposed"
        bumps = smooth_noise(mesh.noise_uv, config.hold_ripple_m, config.hold_ripple_width_m, np.random.default_rng(1))
        if held_from is None:
            held_from = float(body.shaped.joints[body.shaped.body.joint_names.index("upperarm01.L")][1])
        below = np.maximum(held_from - rest[:, 1], 0) / config.hold_depth_m
        share = config.hold_floor + (1 - config.hold_floor) * np.exp(-(below**2))
        rest = rest + bumps[:, None] * vertex_normals(rest, mesh.faces)
        limbs = np.zeros((len(rest), 3))
        if made is not None and made.tailoring.sleeves:
            names = body.shaped.body.joint_names
            for column, side in enumerate(ARM_SIDES):
                bones = [i for i, name in enumerate(names) if name.endswith(side) and name.startswith(ARM_BONES)]
                limbs[:, column] = np.clip(weights[:, bones].sum(axis=1), 0, 1)
            limbs[:, 2] = (1 - limbs[:, :2].sum(axis=1)) * (1 - np.exp(-(below**2)))
        return Hold(rest, weights, ((2 * np.pi * config.hold_hz) ** 2 * share * masses)[:, None], limbs)

    def places(self, body: PosedBody) -> np.ndarray:
        """Where the springs end in a pose, (V, 3) metres."""
        return skin(self.rest, self.skin_weights, body.transforms)

    def slides(self, body: PosedBody) -> np.ndarray:
        """Directions, (V, 3) of length 0 to 1, along which cloth goes up and down an arm or the trunk as it likes.

        Skin along a shoulder seam is half as long again with arms low as with arms up, and cloth is not; a shirt whose
        arms are overhead goes up.
        """
        names, centres = body.shaped.body.joint_names, body.joint_centres()
        ends = [(f"upperarm01{side}", f"lowerarm01{side}") for side in ARM_SIDES] + [("neck01", "root")]
        axes = np.array([centres[names.index(end)] - centres[names.index(start)] for start, end in ends])
        slides = np.sqrt(self.limbs) @ (axes / np.linalg.norm(axes, axis=1, keepdims=True))
        # Where an arm and the trunk share a vertex: longer than 1, it would be driven from its place.
        return slides / np.maximum(np.linalg.norm(slides, axis=1, keepdims=True), 1)

    def forces(self, places: np.ndarray, slides: np.ndarray, points: np.ndarray) -> np.ndarray:
        """What pulls some points, (V, 3), to their places, but for the way along their slides, (V, 3) N."""
        away = places - points
        return self.stiffness * (away - slides * (slides * away).sum(axis=1, keepdims=True))


@dataclass(frozen=True, slots=True, eq=False)
class Walls:
    """Soft planes between the arms of one pose and the trunk: a sleeve stays on its own side, the trunk on the other.

    They stand in for contact of cloth with cloth where it shows most.
    """

    sleeves: tuple[Sleeve, ...]
    planes: tuple[Wall, ...]
    stiffness: np.ndarray
    """(V,) N/m."""

    @staticmethod
    def of(made: Made | None, body: PosedBody, masses: np.ndarray) -> Walls | None:
        if made is None or not made.folds.wall_hz:
            return None
        sleeves = made.tailoring.sleeves
        return Walls(sleeves, walls(sleeves, body), (2 * np.pi * made.folds.wall_hz) ** 2 * masses)

    def push(self, points: np.ndarray, forces: np.ndarray) -> None:
        """Add to forces, (V, 3) N, what drives cloth at some points, (V, 3), back to its side."""
        for sleeve, wall in zip(self.sleeves, self.planes, strict=True):
            heights, below = wall_heights(points, sleeve, wall)
            depth = np.minimum(WALL_MARGIN_M, WALL_OPENING * below) - heights
            deep = (below > 0) & (depth > 0)
            rows, away = sleeve.rows[deep], (sleeve.signs * depth)[deep]
            forces[rows] += (self.stiffness[rows] * away)[:, None] * wall.normal
