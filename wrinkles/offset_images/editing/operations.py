"""Changes to offset images, each under a soft mask: shift, inflate, paint, and wrinkles of another image.

Images hold centimetres along tangent, bitangent and normal (red, green, blue), front before back, (size, size, 6).

References: Jin et al., A pixel-based framework for data-driven clothing, SCA 2020, appendix B.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, assert_never

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64
from scipy.ndimage import gaussian_filter

from capture4d.errors import InputError
from capture4d.files.atomic import read_json
from capture4d.files.json_values import number, text
from capture4d.files.reading import reading

__all__ = ["Operation", "apply_operation", "parse_operations", "read_operations"]

Kind = Literal["shift", "inflate", "paint", "transfer"]
SIDES = {"front": (0,), "back": (1,), "both": (0, 1)}
VALUES: Mapping[Kind, Mapping[str, float]] = {
    "shift": {"du_cm": 0.0, "dv_cm": 0.0},
    "inflate": {"gain": 1.0, "add_cm": 0.0},
    "paint": {"height_cm": 1.0},
    "transfer": {"scale": 1.0, "finer_than_texels": 9.0},
}
"""What each kind is told, and its usual value."""


@dataclass(frozen=True, slots=True)
class Operation:
    """One change."""

    kind: Kind
    values: Mapping[str, float]
    sides: tuple[int, ...] = (0, 1)
    """0 front, 1 back."""
    stroke: tuple[tuple[float, float], ...] = ()
    """Places (u, v) in the picture that the brush goes through, v upwards; everywhere if empty."""
    radius: float = 0.1
    """Of the brush, as a share of the picture's side: there its effect is 1/e."""
    source: str = ""
    """Folder of the image whose wrinkles are transferred."""


def read_operations(path: Path) -> list[Operation]:
    """`parse_operations` of a JSON file.

    Raises:
        InputError: the file is missing, damaged, or says something else.
    """
    with reading(path, "file of operations"):
        return parse_operations(read_json(path))


def parse_operations(tree: Mapping[str, Any]) -> list[Operation]:
    """The operations of a file {"operations": [{"do": "paint", "height_cm": 1.6, "stroke": [[0.5, 0.4]], ...}]}.

    Raises:
        InputError: one is unknown, or told what it does not know.
    """
    rows = tree.get("operations")
    if not isinstance(rows, list) or not rows:
        raise InputError("expected a list of operations as 'operations', found none")
    return [_parsed(row, f"operations[{place}]") for place, row in enumerate(rows)]


def _parsed(row: Any, name: str) -> Operation:
    if not isinstance(row, dict):
        raise InputError(f"{name}: expected an object")
    kind: Kind | None = next((each for each in VALUES if each == row.get("do")), None)
    if kind is None:
        raise InputError(f"{name}.do: expected {', '.join(VALUES)}, found {str(row.get('do'))[:40]!r}")
    known = {"do", "side", "stroke", "radius", *VALUES[kind], *(("from",) if kind == "transfer" else ())}
    strange = sorted(set(row) - known)
    if strange:
        raise InputError(f"{name}: expected {', '.join(sorted(known))} of {kind}, found {strange[0][:40]!r}")
    side = text(row.get("side", "both"), f"{name}.side")
    if side not in SIDES:
        raise InputError(f"{name}.side: expected {', '.join(SIDES)}, found {side[:40]!r}")
    places = row.get("stroke", [])
    if not isinstance(places, list) or any(not isinstance(place, list) or len(place) != 2 for place in places):
        raise InputError(f"{name}.stroke: expected a list of places [u, v]")
    stroke = tuple((number(u, f"{name}.stroke"), number(v, f"{name}.stroke")) for u, v in places)
    radius = number(row.get("radius", 0.1), f"{name}.radius")
    values = {key: number(row.get(key, usual), f"{name}.{key}") for key, usual in VALUES[kind].items()}
    if radius <= 0 or values.get("finer_than_texels", 1.0) <= 0:
        raise InputError(f"{name}: expected a radius and texels above 0")
    source = text(row.get("from", ""), f"{name}.from")
    if kind == "transfer" and not source:
        raise InputError(f"{name}.from: expected the folder of another drawn frame, found none")
    return Operation(kind, values, SIDES[side], stroke, radius, source)


def apply_operation(
    images: Float32[np.ndarray, "size size 6"],
    operation: Operation,
    mask: Bool[np.ndarray, "size size 2"],
    other: Float32[np.ndarray, "size size 6"] | None = None,
) -> Float32[np.ndarray, "size size 6"]:
    """The images after a change.

    Args:
        mask: texels that show cloth or padding.
        other: the image whose wrinkles are transferred.
    """
    changed, soft = images.astype(np.float64), brush(operation, len(images))
    told = operation.values
    for side in operation.sides:
        red, blue = 3 * side, 3 * side + 2
        match operation.kind:
            case "shift":
                changed[..., red] += told["du_cm"] * soft
                changed[..., red + 1] += told["dv_cm"] * soft
            case "inflate":
                changed[..., blue] += soft * ((told["gain"] - 1) * changed[..., blue] + told["add_cm"])
            case "paint":
                changed[..., blue] += told["height_cm"] * soft
            case "transfer":
                assert other is not None
                part = slice(red, red + 3)
                sigma = told["finer_than_texels"]
                fine, own = (
                    each[..., part] - smoothed(each[..., part], mask[..., side], sigma) for each in (other, images)
                )
                changed[..., part] += soft[..., None] * (told["scale"] * fine - own)
            case _:
                assert_never(operation.kind)
    shown = np.repeat(mask, 3, axis=2)
    return np.where(shown, changed, images).astype(np.float32)


def brush(operation: Operation, size: int) -> Float64[np.ndarray, "size size"]:
    """How much of a change each texel gets, from 0 to 1: exp(-(d / radius)^2), d from the stroke."""
    if not operation.stroke:
        return np.ones((size, size))
    centre = (np.arange(size) + 0.5) / size
    u, v = np.meshgrid(centre, 1 - centre)
    nearest = np.full((size, size), np.inf)
    places = np.array(operation.stroke)
    for start, end in zip(places, np.concatenate([places[1:], places[-1:]]), strict=True):
        along = end - start
        share = ((u - start[0]) * along[0] + (v - start[1]) * along[1]) / max(float(along @ along), 1e-12)
        share = np.clip(share, 0, 1)
        nearest = np.minimum(nearest, np.hypot(u - start[0] - share * along[0], v - start[1] - share * along[1]))
    return np.exp(-((nearest / operation.radius) ** 2))


def smoothed(
    image: Float[np.ndarray, "size size 3"], mask: Bool[np.ndarray, "size size"], sigma: float
) -> Float64[np.ndarray, "size size 3"]:
    """A Gaussian blur that sees the texels of the mask alone: of those times the values, over that of the mask."""
    weight = gaussian_filter(mask.astype(np.float64), sigma)
    blurred = gaussian_filter(np.where(mask[..., None], image, 0.0).astype(np.float64), (sigma, sigma, 0))
    return blurred / np.maximum(weight, 1e-6)[..., None]
