"""In what unit a garment mesh is, and which of its axes points up: as it lies on the body under it.

The rotations of a scan that `capture4d check` tries are tried here, in every unit: 24 ways to turn a mesh by quarter
turns. What a mesh says of itself, metres with Y up, is doubted only where it lies much better otherwise.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial import KDTree

from capture4d.body.skinning import PosedBody
from capture4d.captures.placement import Placement
from capture4d.templates.config import Axis, MeshUnits
from capture4d.types import Mesh
from capture4d.units import METRES, Units

__all__ = ["Placed", "axis_name", "find_placement"]

POINTS = 500
"""Vertices that are looked at."""
CLIP_M = 0.3
"""How far from the body a vertex may count."""
FAULT = 1.12
"""Other units or axes are believed if the mesh lies nearer by this factor, as in `capture4d check`."""
SIZES_M = (0.15, 3.0)
"""Smaller and larger meshes are no garments; beside a foot a speck would lie as near as a shirt."""


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """How a mesh was understood."""

    placement: Placement
    units: Units
    distance_m: float
    """Of its vertices from the body so, mean, none counting more than `CLIP_M`."""

    @property
    def turned(self) -> bool:
        """Its axes are others than Y up, facing Z."""
        return bool((self.placement.axes != np.eye(3)).any())

    def told(self) -> str:
        """In words: the unit, and the axes where they are others than ours."""
        axes = f", up is {axis_name(self.placement.axes[1])}, front is {axis_name(self.placement.axes[2])}"
        return f"in {self.units}{axes if self.turned else ''}"


def axis_name(row: Float64[np.ndarray, "3"]) -> str:
    """+X to -Z: the axis of a mesh that a row of a signed permutation takes."""
    axis = int(np.abs(row).argmax())
    return f"{'-' if row[axis] < 0 else '+'}{'XYZ'[axis]}"


def find_placement(mesh: Mesh, body: PosedBody, *, units: MeshUnits = "auto", up: Axis | None = None) -> Placed:
    """Find the unit and the quarter turns with which a mesh lies nearest to a body.

    Args:
        mesh: as its file has it.
        body: in the pose in which the garment lies on it.
        units: of the mesh; tried if "auto".
        up: axis of the mesh that points up; then only turns about the vertical are tried.
    """
    chosen = np.linspace(0, len(mesh.vertices) - 1, min(POINTS, len(mesh.vertices))).astype(int)
    points = mesh.vertices[chosen].astype(np.float64)
    size = float(np.ptp(points, axis=0).max(initial=0.0))
    turns = [turn for turn in _quarter_turns() if up is None or _points_up(turn, up)]
    usual: Units = "m" if units == "auto" else units
    possible: list[Units] = [usual]
    if units == "auto":
        every: tuple[Units, ...] = tuple(METRES)
        possible.extend(unit for unit in every if unit != usual and SIZES_M[0] <= size * METRES[unit] <= SIZES_M[1])
    tree = KDTree(body.vertices())
    ways: list[tuple[float, Placed]] = []
    for unit, turn in itertools.product(possible, turns):
        found, _ = tree.query(METRES[unit] * points @ turn.T, distance_upper_bound=CLIP_M)
        distance = float(np.minimum(found, CLIP_M).mean())
        as_told = unit == usual and (turn == np.eye(3)).all()
        ways.append((distance * (1.0 if as_told else FAULT), Placed(Placement(METRES[unit], turn), unit, distance)))
    return min(ways, key=lambda way: way[0])[1]


def _quarter_turns() -> list[np.ndarray]:
    """The 24 rotations that take axes to axes."""
    turns = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            turn[range(3), order] = signs
            if np.linalg.det(turn) > 0:
                turns.append(turn)
    return turns


def _points_up(turn: np.ndarray, up: Axis) -> bool:
    return axis_name(turn[1]).lower() == (up if up.startswith("-") else f"+{up}")
