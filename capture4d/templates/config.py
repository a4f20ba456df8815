"""Settings of templates; the standard library alone, for the command line's sake."""

from __future__ import annotations

from typing import Literal

from capture4d.settings import Whole, settings
from capture4d.units import Units

__all__ = ["TEMPLATE", "Axis", "Follow", "MeshUnits", "Region", "TemplateConfig", "UvChoice"]

Region = Literal["tshirt", "longsleeve", "trousers", "shorts"]
UvChoice = Literal["auto", "keep", "fresh", "none"]
Follow = Literal["skin", "distance", "root"]
Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
MeshUnits = Literal["auto", Units]


@settings
class TemplateConfig:
    """What becomes of a garment mesh, or of which part of the body a template is made."""

    pose_frame: Whole | None = None
    """Frame of the motion file in which the garment lies on the body, by its number; the first if None."""
    region: Region | None = None
    """Part of the body to take as the garment, instead of a mesh."""
    uv: UvChoice = "auto"
    """Keep the mesh's UVs or cut fresh ones; `auto` keeps them if nothing is wrong with them."""
    loop_names: tuple[str, ...] = ()
    """Names of the border loops, the one with the most vertices first; found by their place if empty."""
    mesh_units: MeshUnits = "auto"
    """Of the mesh; `auto` takes the unit in which it lies on the body."""
    up: Axis | None = None
    """Axis of the mesh that points up; found by how it lies on the body if None."""
    uv_is_pattern: bool = False
    """The mesh's UVs are its sewing pattern, whatever they look like."""
    wrap: bool = False
    """Bind the mesh to where it comes to lie when it is shrunk onto the body, instead of to its nearest body points."""
    follow: Follow = "skin"
    """What moves the garment: the skin beneath each point; of one that hangs loose, such as a skirt, the mean of the
    trunk and legs around it, weighted by inverse distance; or the root joint alone."""


TEMPLATE = TemplateConfig()
