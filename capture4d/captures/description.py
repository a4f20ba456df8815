"""capture.json, judged entry by entry: what a lab says of a take.

`read_capture` and the preflight check read it here, so that they refuse the same, in the same words. Entries that are
not known are left alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, get_args

from capture4d.captures.names import require_plain_names, require_text
from capture4d.colours.spaces import Colour, parse_colour
from capture4d.errors import InputError
from capture4d.files.reading import shortened
from capture4d.units import Units
from capture4d.value_checks import LARGEST_RATE, SMALLEST_RATE

__all__ = ["FORMAT", "LAST_FRAME", "Description", "parse_description"]

FORMAT = 1
LAST_FRAME = 2**31 - 1
"""Frame numbers are int32 in every array of theirs."""


@dataclass(frozen=True, slots=True, eq=False)
class Description:
    """What capture.json says; None and empty where it says nothing."""

    name: str | None
    fps: float | None
    units: Units
    garment_colour: Colour | None
    boundary_colours: Mapping[str, Colour]
    frames: tuple[int, ...] | None
    dropped: tuple[int, ...]


def parse_description(found: Mapping[str, Any]) -> Description:
    """Judge the entries of a capture.json.

    Raises:
        InputError: an entry is not what it has to be; the message names the entry.
    """
    given = {key: value for key, value in found.items() if value is not None}
    if "format" in given and not (_is_whole(given["format"]) and given["format"] == FORMAT):
        raise InputError(f"expected format {FORMAT}, found {_shown(given['format'])}")
    frames = _frames(given["frames"], "frames") if "frames" in given else None
    if frames is not None and (not frames or list(frames) != sorted(set(frames))):
        said = "none" if not frames else _shown(list(frames))
        raise InputError(f"frames: expected ascending frame numbers, each once, found {said}")
    return Description(
        name=require_text(given["name"], "name") if "name" in given else None,
        fps=_fps(given["fps"]) if "fps" in given else None,
        units=_units(given.get("units", "m")),
        garment_colour=_colour(given["garment_colour"], "garment_colour") if "garment_colour" in given else None,
        boundary_colours=_boundary_colours(given.get("boundary_colours", {})),
        frames=frames,
        dropped=_frames(given.get("dropped_frames", []), "dropped_frames"),
    )


def _is_whole(value: object) -> bool:
    """A whole number; some writers know no other kind than 12.0."""
    return not isinstance(value, bool) and (isinstance(value, int) or (isinstance(value, float) and value.is_integer()))


def _frames(value: object, entry: str) -> tuple[int, ...]:
    if not isinstance(value, list):
        raise InputError(f"{entry}: expected a list of frame numbers, found {_shown(value)}")
    for number in value:
        if not _is_whole(number) or not 0 <= number <= LAST_FRAME:
            raise InputError(f"{entry}: expected whole numbers from 0 to {LAST_FRAME}, found {_shown(number)}")
    return tuple(int(number) for number in value)


def _fps(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(f"fps: expected a number, found {_shown(value)}")
    if not value > 0:
        raise InputError(f"fps: expected a positive frame rate, found {_shown(value)}")
    if not SMALLEST_RATE <= value <= LARGEST_RATE:
        expected = f"a frame rate from {SMALLEST_RATE:g} to {LARGEST_RATE:g}"
        raise InputError(f"fps: expected {expected}, found {_shown(value)}")
    return float(value)


def _units(value: object) -> Units:
    for units in get_args(Units):
        if value == units:
            return units
    raise InputError(f"expected units {', '.join(get_args(Units))}, found {_shown(value)}")


def _colour(value: Any, entry: str) -> Colour:
    fault = InputError(f"{entry}: expected a colour such as #2f62c9, found {_shown(value)}")
    if not isinstance(value, str):
        raise fault
    try:
        return parse_colour(value)
    except InputError:
        raise fault from None


def _boundary_colours(value: object) -> dict[str, Colour]:
    if not isinstance(value, dict):
        raise InputError(f"boundary_colours: expected an object of names and colours, found {_shown(value)}")
    require_plain_names(value, "border")
    return {name: _colour(colour, f"boundary_colours, {name}") for name, colour in value.items()}


def _shown(value: object) -> str:
    if isinstance(value, str):
        return shortened(ascii(value), 60)
    if isinstance(value, int) and abs(value) > 10**40:  # more digits than Python is willing to print
        return "a number of more than 40 digits"
    return shortened(ascii(value), 60)
