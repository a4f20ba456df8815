"""What garments are made of. Standard library only, as all settings."""

from __future__ import annotations

from typing import Annotated

from capture4d.settings import NonNegative, Positive, Range, Share, settings

__all__ = ["FABRICS", "Fabric", "Shrink"]

Shrink = Annotated[float, Range(above=0, most=1)]


@settings
class Fabric:
    """What the cloth is made of."""

    name: str = "jersey"
    density: Positive = 0.2
    """Mass of an area, kg/m2."""
    stretch_stiffness: Positive = 200.0
    """Membrane stiffness of the coarse sheet, N/m. Its own weight stretches a shirt by half a percent at 200; at 1000
    the solver is so far from converged that the hem hangs 26 mm too low."""
    coarse_bending: NonNegative = 5e-4
    """Bending stiffness of the coarse sheet, N m."""
    friction: NonNegative = 0.05
    """Coulomb coefficient between cloth and body."""
    shrink: tuple[Shrink, Shrink] = (0.93, 0.98)
    """Size of the coarse rest pattern across and along the grain; the rest becomes fine folds."""
    fold_bending: Share = 0.17
    """Bending gain of the wrinkle mesh, 0 to 1: more makes wider folds."""
    grain_bending: Positive = 1.0
    """Bending stiffness along the grain over that across it, of garments with a `FoldConfig`."""


FABRICS = {
    "jersey": Fabric(),
    "shirt-cotton": Fabric(
        "shirt-cotton", density=0.13, stretch_stiffness=130.0, coarse_bending=5e-4, fold_bending=0.15
    ),
    "linen": Fabric(
        "linen", density=0.18, stretch_stiffness=180.0, coarse_bending=5e-4, fold_bending=0.25, shrink=(0.91, 0.975)
    ),
    "denim": Fabric(
        "denim", density=0.4, stretch_stiffness=400.0, coarse_bending=1.5e-3, fold_bending=0.4, grain_bending=1.8
    ),
    "wool": Fabric(
        "wool", density=0.28, stretch_stiffness=260.0, coarse_bending=8e-4, fold_bending=0.3, grain_bending=1.3
    ),
    "twill": Fabric(
        "twill", density=0.28, stretch_stiffness=280.0, coarse_bending=8e-4, fold_bending=0.25, shrink=(0.95, 0.985)
    ),
}
