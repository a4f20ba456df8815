"""Units of length that files come in."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal

__all__ = ["METRES", "Units"]

Units = Literal["m", "cm", "mm", "in"]

METRES: Mapping[Units, float] = MappingProxyType({"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254})
"""Metres in a unit."""
