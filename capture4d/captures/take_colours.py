"""What the vertices of a take can be: the colours that capture.json gives, and those learned from its scans.

Learned is what an absent `garment_colour` leaves open, or everything where that is asked for; colours that are given
then say which of the learned ones is which. A few frames are read, spread over the take.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from capture4d.captures.capture import Capture, read_scan
from capture4d.colours.learning import Light, learn_colours
from capture4d.colours.spaces import Colour
from capture4d.errors import InputError
from capture4d.types import Scan

__all__ = ["KnownColours", "take_colours", "template_loops"]

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
        return KnownColours(found.garment, named, tuple(named), found.others, found.light)
    names = template_loops(capture)
    if len(found.paints) == 1:
        named = dict.fromkeys(names or ("border",), found.paints[0])
    else:
        named = {f"paint_{index}": paint for index, paint in enumerate(found.paints)}
    return KnownColours(found.garment, named, names or tuple(named), found.others, found.light)


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
