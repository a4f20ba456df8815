"""A style set: drapes of one garment in many styles on many people, and which of them are kept for tests.

OUT/styles.json          the range of every style number and shape component; pairs of style and shape, by name
OUT/canonical.npz        every pair that was tried at rest in the A-pose (`styles`, `shapes`, `vertices`, `test`)
OUT/pairs/NAME           a set of drapes of each prototype and each test pair, `capture4d.captures.drapes.drape_sets`

A prototype is simulated in many poses. A test pair is one that nothing is learned from, in poses of either kind. Poses
up to the number `unseen_poses` are learned from with no pair, so that there are four parts: prototypes or test pairs,
in poses that were seen or not. A pose is drawn from the seed and its number, again and again until no limb enters
another, which may take one more draw on one person than on another: what is held back is held back by number.

References: TailorNet (CVPR 2020), sections 5.2 and 5.3.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from capture4d.captures.drapes.drape_sets import DrapeSet, read_drapes
from capture4d.errors import InputError
from capture4d.files.arrays import ArrayFile
from capture4d.files.atomic import read_json
from capture4d.files.json_values import entry, number, text, whole
from capture4d.files.reading import reading
from capture4d.runs.stage import complete_record
from capture4d.value_checks import require_array, require_finite

__all__ = ["CanonicalDrapes", "Ranges", "StylePair", "StyleSet", "read_style_set"]

Role = Literal["prototype", "test"]
STAGE = "synth-styles"
OUTSIDE = 1e-4
"""By how much a number may be outside its range, in half ranges: what rounding does."""


@dataclass(frozen=True, slots=True)
class Ranges:
    """Which numbers vary, and from where to where: a pair of style and shape as numbers from -1 to 1."""

    style: Mapping[str, tuple[float, float]]
    """Least and most of each number of the style, by name: one of the pattern that varies, or a component."""
    shape: Sequence[tuple[float, float]]
    """Least and most of each shape component, up to the last that varies; those between may be fixed."""

    @property
    def size(self) -> int:
        """Numbers of a pair."""
        return len(self.style) + sum(low < high for low, high in self.shape)

    @property
    def centre_style(self) -> dict[str, float]:
        return {name: (low + high) / 2 for name, (low, high) in self.style.items()}

    def numbers(
        self, style: Mapping[str, float], shape: Sequence[float] | Float[np.ndarray, " shapes"]
    ) -> Float64[np.ndarray, " numbers"]:
        """Style and shape as one vector, phi = (gamma, beta): -1 the least, 1 the most of what was learned.

        Args:
            style: the numbers that vary, by name; those left out are in the middle of their range. Others are ignored.
            shape: in standard deviations; components left out at the end are 0.
        Raises:
            InputError: a number is outside its range.
        """
        found = []
        for name, (low, high) in self.style.items():
            found.append(_place(style.get(name, (low + high) / 2), low, high, f"style {name}"))
        for index in range(max(len(shape), len(self.shape))):
            low, high = self.shape[index] if index < len(self.shape) else (0.0, 0.0)
            value = float(shape[index]) if index < len(shape) else 0.0
            place = _place(value, low, high, f"beta {index + 1}")
            if low < high:
                found.append(place)
        return np.array(found)

    def named(self, values: Sequence[float]) -> dict[str, float]:
        """Style numbers by name, of values in the order of the ranges; the last may be left out.

        Raises:
            InputError: there are more values than names.
        """
        if len(values) > len(self.style):
            raise InputError(f"style: expected at most {len(self.style)} numbers, {', '.join(self.style)}; "
                             f"found {len(values)}")  # fmt: skip
        return dict(zip(self.style, map(float, values), strict=False))

    def values(self, numbers: Float[np.ndarray, " numbers"]) -> tuple[dict[str, float], tuple[float, ...]]:
        """Style, by name, and shape that a vector of `numbers` tells: what `numbers` was made from."""
        places = [float(each) for each in numbers]
        style = {
            name: (low + high) / 2 + place * (high - low) / 2
            for (name, (low, high)), place in zip(self.style.items(), places, strict=False)
        }
        rest = iter(places[len(style) :])
        shape = tuple((low + high) / 2 + (next(rest) if low < high else 0.0) * (high - low) / 2
                      for low, high in self.shape)  # fmt: skip
        return style, shape


def _place(value: float, low: float, high: float, name: str) -> float:
    half = (high - low) / 2
    slack = OUTSIDE * (half or 1.0)
    if not low - slack <= value <= high + slack:
        expected = f"{low:g} to {high:g}, as it was learned" if low < high else f"{low:g}, for it was not varied"
        raise InputError(f"{name}: expected {expected}, found {value:g}")
    return (value - (low + high) / 2) / half if half else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class StylePair:
    """A style on a person, in many poses."""

    name: str
    role: Role
    drapes: DrapeSet
    canonical: Float32[np.ndarray, "verts 3"]
    """At rest in the A-pose, which is the body's rest pose, metres."""
    style: Mapping[str, float]
    """Numbers of the style, by the names of the ranges: those of the pattern that vary, or components."""


@dataclass(frozen=True, slots=True, eq=False)
class CanonicalDrapes:
    """Pairs at rest in the A-pose."""

    styles: Float64[np.ndarray, "tried styles"]
    """Numbers of the style, in the order of the ranges."""
    shapes: Float64[np.ndarray, "tried shapes"]
    vertices: Float32[np.ndarray, "tried verts 3"]
    """Metres."""
    test: Bool[np.ndarray, " tried"]
    """Test pairs, which nothing is learned from."""

    def __post_init__(self) -> None:
        count = len(self.vertices)
        require_array("CanonicalDrapes", "styles", self.styles, (count, None), np.float64)
        require_array("CanonicalDrapes", "shapes", self.shapes, (count, None), np.float64)
        require_array("CanonicalDrapes", "vertices", self.vertices, (None, None, 3), np.float32)
        require_array("CanonicalDrapes", "test", self.test, (count,), np.bool_)
        for name in ("styles", "shapes", "vertices"):
            require_finite("CanonicalDrapes", name, getattr(self, name))


@dataclass(frozen=True, slots=True, eq=False)
class StyleSet:
    """What a garment in all its styles is learned from; the first pair is a prototype, whose binding all share."""

    ranges: Ranges
    pairs: Sequence[StylePair]
    canonical: CanonicalDrapes
    unseen_poses: int
    """Drapes numbered up to this are in poses that nothing is learned from."""
    digest: str


def read_style_set(folder: Path) -> StyleSet:
    """Read a finished style set with all its drapes.

    Raises:
        InputError: the folder holds none, an unfinished one, or one that is damaged or does not fit together.
    """
    record = complete_record(folder, STAGE, f"capture4d synth-drapes {folder} --preset PRESET")
    path = folder / "styles.json"
    about = read_json(path)
    with reading(path, "description of a style set"):
        ranges = _ranges(about)
        unseen = whole(entry(about, "unseen_poses"), "unseen_poses")
        rows = _rows(about)
    with ArrayFile(folder / "canonical.npz") as arrays:
        canonical = CanonicalDrapes(arrays["styles"], arrays["shapes"], arrays["vertices"], arrays["test"])
        if canonical.styles.shape[1] != len(ranges.style):
            raise InputError(f"styles: expected {len(ranges.style)} numbers, found {canonical.styles.shape[1]}")
    pairs = []
    for name, role, row in rows:
        if row >= len(canonical.vertices):
            raise InputError(f"pairs: expected one of {len(canonical.vertices)} A-poses, found {row}", where=path)
        drapes = read_drapes(folder / "pairs" / name)
        style = dict(zip(ranges.style, canonical.styles[row].tolist(), strict=True))
        pairs.append(StylePair(name, role, drapes, canonical.vertices[row], style))
    _require_one_garment(folder, pairs)
    return StyleSet(ranges, pairs, canonical, unseen, record["digest"])


def _ranges(about: Mapping[str, Any]) -> Ranges:
    styles, shapes = entry(about, "style_ranges"), entry(about, "shape_ranges")
    if not isinstance(styles, dict) or not isinstance(shapes, list):
        raise InputError("expected an object of style_ranges and a list of shape_ranges, found something else")
    found = Ranges(
        {name: _limits(value, f"style_ranges.{name}") for name, value in styles.items()},
        [_limits(value, "shape_ranges") for value in shapes],
    )
    if any(low >= high for low, high in found.style.values()):
        raise InputError("style_ranges: expected the least before the most, found them otherwise")
    return found


def _limits(value: Any, name: str) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) != 2:
        raise InputError(f"{name}: expected the least and the most, found something else")
    low, high = (number(each, name) for each in value)
    if low > high:
        raise InputError(f"{name}: expected the least first, found {low:g} and {high:g}")
    return low, high


def _rows(about: Mapping[str, Any]) -> list[tuple[str, Role, int]]:
    """Name, role and A-pose of each pair, prototypes first."""
    found = []
    pairs = entry(about, "pairs")
    for name, value in pairs.items() if isinstance(pairs, dict) else ():
        role = text(entry(value, "role"), "role")
        if role not in get_args(Role) or Path(name).name != name:
            raise InputError(
                f"pairs: expected roles of {' or '.join(get_args(Role))} by name, found {role!r}, {name!r}"
            )
        found.append((name, role, whole(entry(value, "canonical"), "canonical")))
    if not any(role == "prototype" for _, role, _ in found):
        raise InputError("pairs: expected at least one prototype, found none")
    return sorted(found, key=lambda each: each[1] != "prototype")


def _require_one_garment(folder: Path, pairs: Sequence[StylePair]) -> None:
    """Raises InputError unless all pairs have the faces of the first, on one skeleton."""
    first = pairs[0].drapes
    for pair in pairs:
        mesh, body = pair.drapes.garment.template, pair.drapes.body
        same = np.array_equal(mesh.faces, first.garment.template.faces) and body.joint_names == first.body.joint_names
        if not same or len(mesh.vertices) != len(pair.canonical):
            raise InputError("expected the mesh and the joints of the first pair, found others",
                             where=folder / "pairs" / pair.name)  # fmt: skip
