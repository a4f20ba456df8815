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
        _, _, weights = bind(cloth, mesh.faces, body, smoothing=WEIGHT_SMOOTHING if held_from is None else 0)
        adjacency = vertex_adjacency(mesh.faces, mesh.vertex_count).astype(np.float64)
        around = np.asarray(adjacency.sum(axis=1)).reshape(-1, 1)
        for _ in range(0 if made is None else made.folds.hold_spread):
            weights = 0.5 * weights + 0.5 * (adjacency @ weights) / around
        rest, flagged = unskin(cloth, weights, body.transforms)
        assert not flagged.any(), "the dressing pose cannot be unposed"
        bumps = smooth_noise(mesh.noise_uv, config.hold_ripple_m, config.hold_ripple_width_m, np.random.default_rng(1))
        if held_from is None:
            held_from = float(body.shaped.joints[body.shaped.body.joint_names.index("upperarm01.L")][1])
        below = np.maximum(held_from - rest[:, 1], 0) / config.hold_depth_m
        share = config.hold_floor + (1 - config.hold_floor) * np.exp(-(below**2))
        rest = rest + bumps[:, None] * vertex_normals(rest, mesh.faces)
        return Hold(rest, weights, ((2 * np.pi * config.hold_hz) ** 2 * share * masses)[:, None])

    def places(self, body: PosedBody) -> np.ndarray:
        """Where the springs end in a pose, (V, 3) metres."""
        return skin(self.rest, self.skin_weights, body.transforms)


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
