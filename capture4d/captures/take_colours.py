"""What the vertices of a take can be: the colours that capture.json gives, and those learned from its scans.

Learned is what an absent `garment_colour` leaves open, or everything where that is asked for; colours that are given
then say which of the learned ones is which. A few frames are read, spread over the take. A stage keeps what was learned
in its folder, colours.json, so that a frame that comes later does not change what all others were made with.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.captures.capture import Capture, read_scan
from capture4d.colours.learning import Light, learn_colours
from capture4d.colours.spaces import Colour, format_colour, parse_colour
from capture4d.errors import InputError
from capture4d.files.atomic import read_json, write_json
from capture4d.files.reading import reading
from capture4d.runs.decisions import GIVEN
from capture4d.runs.frame_lists import listed
from capture4d.runs.made import digest_of
from capture4d.types import Scan

__all__ = [
    "COLOURS",
    "KnownColours",
    "colours_of_take",
    "described_colours",
    "kept_colours",
    "read_colours",
    "take_colours",
    "template_loops",
]

COLOURS = "colours.json"
"""In the folder of a stage that reads colours."""

FRAMES = 4
"""Scans that colours are learned from."""


@dataclass(frozen=True, slots=True, eq=False)
class KnownColours:
    """sRGB; where they are learned, as under the mean light of the take."""

    garment: Colour
    boundary: Mapping[str, Colour]
    """Paint on each named border."""
    loop_names: tuple[str, ...]
    """Of the garment's borders. Where they differ from the names of the paints, no paint tells its loop."""
    others: tuple[Colour, ...] = ()
    light: Light | None = None
    """None: given, not learned."""
    printed: bool = False
    """The garment has many colours, of which `garment` is the most frequent: it is what lies between the paint."""

    def flat(self, scan: Scan) -> Scan:
        """A scan in the light that the colours hold for."""
        return scan if self.light is None else replace(scan, colours=self.light.removed(scan.mesh, scan.colours))


def take_colours(capture: Capture, *, learn: bool = False) -> KnownColours:
    """The colours of a take; learning them reads a few scans and takes seconds.

    Args:
        learn: also where capture.json gives them all.
    Raises:
        ColoursNotSeparableError: what is to be learned cannot be.
        InputError: the first scan cannot be read.
    """
    if capture.garment_colour is not None and not learn:
        return KnownColours(capture.garment_colour, capture.boundary_colours, tuple(capture.boundary_colours))
    boundary = capture.boundary_colours
    paints = tuple(dict.fromkeys(boundary.values()))
    found = learn_colours(
        _some_scans(capture), garment=capture.garment_colour, paints=paints or None, source=str(capture.path)
    )
    if boundary:
        as_seen = dict(zip(paints, found.paints, strict=True))
        named = {name: as_seen[colour] for name, colour in boundary.items()}
        return KnownColours(found.garment, named, tuple(named), found.others, found.light, found.printed)
    names = template_loops(capture)
    if len(found.paints) == 1:
        named = dict.fromkeys(names or ("border",), found.paints[0])
    else:
        named = {f"paint_{index}": paint for index, paint in enumerate(found.paints)}
    return KnownColours(found.garment, named, names or tuple(named), found.others, found.light)


@dataclass(frozen=True, slots=True, eq=False)
class TakenColours:
    """Colours that a stage goes by."""

    colours: KnownColours
    frames: str
    """That they were learned from; empty where they were given."""
    newly: bool
    """They were not kept from an earlier run."""


def colours_of_take(capture: Capture, folder: Path, *, learn: bool = False) -> TakenColours:
    """The colours that a stage goes by: kept in its folder from an earlier run, or found now.

    Args:
        learn: also where capture.json gives them all.
    Raises:
        InputError: as `take_colours`.
    """
    if capture.garment_colour is not None and not learn:
        return TakenColours(take_colours(capture), "", False)
    kept = kept_colours(capture, folder, learn=learn)
    if kept is not None:
        return kept
    taken = TakenColours(take_colours(capture, learn=learn), listed(capture.frame_ids, most=0), True)
    found_from = digest_of(_given(capture, learn))
    write_json(folder / COLOURS, {**described_colours(taken.colours), "frames": taken.frames, "found_from": found_from})
    return taken


def kept_colours(capture: Capture, folder: Path, *, learn: bool = False) -> TakenColours | None:
    """Colours that were learned in an earlier run, if what is said of them is still the same; None otherwise."""
    path = folder / COLOURS
    if not path.is_file():
        return None
    found = read_json(path)
    if not found.get("learned") or found.get("found_from") not in (GIVEN, digest_of(_given(capture, learn))):
        return None
    return TakenColours(read_colours(path), str(found.get("frames", "")), False)


def _given(capture: Capture, learn: bool) -> dict[str, Any]:
    """What decides the colours beside the scans."""
    names = () if capture.boundary_colours else template_loops(capture)
    return {
        "learn": learn or capture.garment_colour is None,
        "units": capture.units,
        "garment": capture.garment_colour,
        "boundary": list(capture.boundary_colours.items()),
        "loops": names,
    }


def described_colours(colours: KnownColours) -> dict[str, Any]:
    """Colours as JSON: all of them, exactly."""
    light = colours.light
    return {
        "learned": light is not None,
        "garment_colour": format_colour(colours.garment),
        "boundary_colours": {name: format_colour(colour) for name, colour in colours.boundary.items()},
        "other_colours": [format_colour(colour) for colour in colours.others],
        "loops": list(colours.loop_names),
        **({"printed": True} if colours.printed else {}),
        "light": None
        if light is None
        else {"coefficients": light.coefficients, "centre": light.centre, "size_m": float(light.size_m)},
    }


def read_colours(path: Path) -> KnownColours:
    """Colours that a stage has written down.

    Raises:
        InputError: the file is missing or damaged.
    """
    found = read_json(path)
    with reading(path, "record of colours"):
        light = found["light"]
        return KnownColours(
            parse_colour(found["garment_colour"]),
            {name: parse_colour(colour) for name, colour in found["boundary_colours"].items()},
            tuple(found["loops"]),
            tuple(parse_colour(colour) for colour in found["other_colours"]),
            None
            if light is None
            else Light(
                np.array(light["coefficients"], np.float64),
                np.array(light["centre"], np.float64),
                float(light["size_m"]),
            ),
            bool(found.get("printed", False)),
        )


def _some_scans(capture: Capture) -> list[Scan]:
    """The first scan that can be read, and others spread over the rest of the take; damaged ones are passed over.

    Raises:
        InputError: none can be read; about the first.
    """
    scans: list[Scan] = []
    faults: list[InputError] = []
    frame_ids = list(capture.frame_ids)
    while frame_ids and not scans:
        try:
            scans.append(read_scan(capture, frame_ids.pop(0)))
        except InputError as error:
            faults.append(error)
    if not scans:
        raise faults[0]
    rows = np.unique(np.linspace(0, len(frame_ids), FRAMES).round().astype(int)[1:]) - 1
    for row in rows[rows >= 0].tolist():
        try:
            scans.append(read_scan(capture, frame_ids[row]))
        except InputError:  # the frame itself will be flagged
            continue
    return scans


def template_loops(capture: Capture) -> tuple[str, ...]:
    """Names of the template's borders, which name what is learned; none without a template."""
    try:
        return tuple(capture.template.loops)
    except InputError:
        return ()
