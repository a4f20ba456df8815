"""What the subject wears, in colours: cloth, the paint on its borders, the suit below it, and bare skin."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

__all__ = ["OUTFITS", "Outfit", "OutfitName", "PrintName"]

Colour = tuple[int, int, int]
OutfitName = Literal["blue", "red", "olive"]
PrintName = Literal["random", "stripes", "checks", "logo"]


@dataclass(frozen=True, slots=True)
class Outfit:
    """sRGB, 0 to 255."""

    garment: Colour
    border: Colour
    suit: Colour = (150, 152, 156)
    skin: Colour = (214, 168, 140)


OUTFITS: Mapping[OutfitName, Outfit] = {
    "blue": Outfit(garment=(47, 98, 201), border=(255, 196, 0)),
    "red": Outfit(garment=(186, 52, 58), border=(52, 178, 96), suit=(92, 92, 100), skin=(150, 105, 80)),
    "olive": Outfit(garment=(118, 128, 58), border=(232, 72, 160), suit=(214, 212, 206)),
}
