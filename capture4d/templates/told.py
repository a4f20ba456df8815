"""What `capture4d template` says of a template it has made."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from capture4d.captures.description import parse_description
from capture4d.captures.names import telling_names, unknown_borders
from capture4d.errors import InputError
from capture4d.files.atomic import read_json
from capture4d.templates.stage import TemplateResult
from capture4d.templates.wrapping import Wrap

__all__ = ["told"]

FROM_THE_MESH = "lengths of the cloth are those of the mesh"
"""A template whose UVs are no pattern."""


def told(result: TemplateResult) -> Iterator[str]:
    """One line each: how the mesh was understood, its size, its borders, its UVs."""
    garment, report, placed = result.garment, result.report, result.placed
    if placed is not None and (placed.turned or placed.units != "m"):
        yield f"read {placed.told()}: so it lies on the body"
    yield f"{report.vertices} vertices, {report.faces} faces, {1e3 * report.distance_m:.1f} mm from the body"
    loops = ", ".join(f"{name} ({len(loop)})" for name, loop in garment.loops.items())
    yield f"borders: {loops}; with these names their paints stand in boundary_colours"
    yield f"UVs: {_uvs(result)}"
    if report.wrap is not None:
        yield f"wrapped: {_wrapped(report.wrap)}"
    yield from _other_names(result)


def _other_names(result: TemplateResult) -> Iterator[str]:
    """If the template lies in a capture whose paints are named after other borders, that: `run` would refuse it."""
    description = result.path.parent / "capture.json"
    if not description.is_file():
        return
    with contextlib.suppress(InputError):  # `check` says what is wrong with it
        paints = parse_description(read_json(description)).boundary_colours
        unknown = unknown_borders(telling_names(paints), result.garment.loops)
        if unknown:
            yield (
                f"{description}: boundary_colours names {', '.join(unknown)}, which the template does not have; "
                "rename the paints there, or the borders with --names"
            )


def _wrapped(wrap: Wrap) -> str:
    turned = f", {wrap.turned_in_percent:.1f} % in turned-in hems and collars" if wrap.turned_in_percent else ""
    return (
        f"{wrap.cage.patch_count} patches in a cage of {len(wrap.cage.vertices)} vertices; edges stretched "
        f"unequally by {100 * wrap.spread:.0f} %, before equalisation {100 * wrap.spread_before:.0f} %; "
        f"{wrap.flipped_percent:.1f} % of the faces face inwards{turned}"
    )


def _uvs(result: TemplateResult) -> str:
    garment, report = result.garment, result.report
    if garment.template.uv is None:
        return f"none; {FROM_THE_MESH}, and a sewing pattern as UVs would make registration more exact"
    if report.fresh_uv:
        faults = ", ".join(report.uv.faults())
        return f"cut afresh{f' ({faults})' if faults else ''}; they are no sewing pattern, so {FROM_THE_MESH}"
    if garment.pattern_metres:
        scale = "in metres" if garment.pattern_metres == 1 else f"with {garment.pattern_metres:.4g} m in a unit"
        return f"kept; a sewing pattern {scale}, from which the cloth has its lengths"
    why = "no area" if report.pattern is None else ", ".join(report.pattern.faults())
    return f"kept; no sewing pattern ({why}), so {FROM_THE_MESH}; --uv-is-pattern says otherwise"
