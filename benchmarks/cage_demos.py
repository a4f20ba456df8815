"""The four pictures with which Jin et al. (SCA 2020, Figs. 20 to 23) show what a cage carries into a patch.

A square patch with a jittered mesh; its cage is its border, of which two sides are moved: a bump on one side, small
bumps on two that meet, a sine, and a bump that leans over. Conductivity along y makes folds of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import Delaunay

from capture4d.geometry.cages.dirichlet import Extension, conductivity_along, dirichlet_form
from capture4d.geometry.mesh import boundary_edges, doubled_area_vectors

FOLD_RATIO = 150.0
"""How much better the anisotropic bases conduct along y than along x."""
SINE_PERIODS, SINE_HEIGHT = 4, 0.05
LEAN = 1.5
BUMPS = {"bump": 0.15, "two_bumps": 0.08}
"""Heights."""
DEMOS = (*BUMPS, "sine", "wave")


@dataclass(frozen=True)
class Patch:
    """The unit square, triangulated."""

    points: np.ndarray
    """(V, 2)"""
    faces: np.ndarray

    @staticmethod
    def jittered(side: int, rng: np.random.Generator) -> Patch:
        """A grid of side x side vertices, those inside shifted by up to a quarter of its width, Delaunay."""
        x, y = np.meshgrid(*[np.linspace(0, 1, side)] * 2, indexing="ij")
        points = np.column_stack([x.ravel(), y.ravel()])
        inside = ((points > 0) & (points < 1)).all(axis=1)
        points[inside] += rng.uniform(-0.25, 0.25, (int(inside.sum()), 2)) / (side - 1)
        faces = Delaunay(points).simplices.astype(np.int32)
        solid = np.column_stack([points, np.zeros(len(points))])
        area = doubled_area_vectors(solid, faces)[:, 2]
        faces = faces[np.abs(area) > 1e-9]  # flat ones along the border
        area = area[np.abs(area) > 1e-9]
        faces[area < 0] = faces[area < 0][:, ::-1]
        return Patch(points, faces)

    @property
    def border(self) -> np.ndarray:
        return np.unique(boundary_edges(self.faces))

    def extension(self, *, folds: bool) -> Extension:
        """Isotropic, or along y."""
        conductivity = conductivity_along(np.array([0.0, 1.0]), FOLD_RATIO) if folds else None
        form = dirichlet_form(self.faces, self.points[self.faces], len(self.points), conductivity=conductivity)
        return Extension(form, self.border)

    def surface(self, moved: np.ndarray) -> np.ndarray:
        """(V, 3) the patch with displacements (V, 3)."""
        return np.column_stack([self.points, np.zeros(len(self.points))]) + moved

    def height_at(self, moved: np.ndarray, x: float, y: float) -> float:
        """Of the vertex that is nearest to a place."""
        return float(moved[np.argmin(np.linalg.norm(self.points - (x, y), axis=1)), 2])


def boundary(name: str, points: np.ndarray) -> np.ndarray:
    """Displacements, (C, 3), of points (C, 2) on the border of the unit square, in one of `DEMOS`."""
    x, y = points.T
    moved = np.zeros((len(points), 3))
    on_low, on_sides = y == 0, (y == 0) | (y == 1)
    match name:
        case "bump":
            moved[on_low, 2] = BUMPS["bump"] * np.exp(-(((x[on_low] - 0.5) / 0.07) ** 2))
        case "two_bumps":
            moved[on_sides, 2] = BUMPS["two_bumps"] * np.exp(-(((x[on_sides] - 0.5) / 0.05) ** 2))
        case "sine":
            moved[on_sides, 2] = SINE_HEIGHT * np.sin(2 * np.pi * SINE_PERIODS * x[on_sides])
        case "wave":
            moved[on_sides, 2] = 0.2 * np.exp(-(((x[on_sides] - 0.4) / 0.13) ** 2))
            moved[on_sides, 0] = LEAN * moved[on_sides, 2]
        case _:
            raise ValueError(name)
    return moved


def sine_exact(points: np.ndarray, ratio: float) -> np.ndarray:
    """The solution of z_xx + ratio z_yy = 0 under the sine's boundary, (V,)."""
    k = 2 * np.pi * SINE_PERIODS
    damped = k / np.sqrt(ratio)
    return SINE_HEIGHT * np.sin(k * points[:, 0]) * np.cosh(damped * (points[:, 1] - 0.5)) / np.cosh(damped / 2)


def facing_down_percent(surface: np.ndarray, faces: np.ndarray) -> float:
    """Faces of a patch that the wave has turned over."""
    return 100.0 * float((doubled_area_vectors(surface, faces)[:, 2] < 0).mean())
