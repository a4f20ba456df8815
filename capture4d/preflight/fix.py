"""`capture4d check --fix`: the take again, without what is safely repaired. The original is only read.

Scans, and a bare template, are rewritten in metres, Y up, faces outside, feet on the floor; poses move along if they
share the floor; frames that cannot be used are left out and named in capture.json as dropped. Frame numbers stay: a
frame's time follows from its number. What needs a person's judgement (paint, light, calibration, other people's poses)
stays as it is.
"""

from __future__ import annotations

import contextlib
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.captures.capture import Capture
from capture4d.captures.description import parse_description
from capture4d.captures.placement import Placement, place, place_rig
from capture4d.captures.take_colours import template_loops
from capture4d.colours.spaces import format_colour, parse_colour
from capture4d.errors import InputError
from capture4d.files.atomic import write_json
from capture4d.files.records import load_poses, save_poses, save_rig
from capture4d.mesh_files.meshes import READABLE, WRITABLE, read_mesh, write_mesh
from capture4d.preflight.check import Checked
from capture4d.preflight.facts import BadFrame
from capture4d.preflight.statistics import outwardness
from capture4d.preflight.take_folder import TakeFolder, read_frame
from capture4d.runs.workers import run_jobs
from capture4d.types import Mesh

__all__ = ["fixed_path", "write_fixed"]

UNUSABLE = ("frame-partial", "frame-repeated", "scale-jump", "poses-missing")
"""Findings whose frames are left out; frames that cannot be read are left out anyway."""


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    frame_id: int
    source: Path
    target: Path
    placement: Placement


def fixed_path(capture: Path) -> Path:
    """Where the corrected take goes unless told otherwise: next to the original."""
    capture = capture.resolve()
    return capture.parent / f"{capture.name}-fixed"


def write_fixed(checked: Checked, output: Path | None = None, *, workers: int = 1) -> Path:
    """Write the corrected take; the new folder. It is there whole or not at all.

    Args:
        output: that folder; `fixed_path` if None.

    Raises:
        InputError: the folder exists, or no frame is left.
    """
    take, output = checked.take, output or fixed_path(checked.take.path)
    if output.exists():
        raise InputError("already there, expected to write the corrected take there; remove it first", where=output)
    if checked.survey is None:
        raise InputError("no readable frame, nothing to correct", where=take.path)
    placement = checked.survey.placement
    unusable = _unusable(checked)
    kept = [number for number in take.files if number not in unusable]
    if not kept:
        raise InputError("no usable frame, nothing to correct", where=take.path)
    partial = output.with_name(f".{output.name}.partial")
    if partial.exists():  # of a run that was killed
        shutil.rmtree(partial)
    (partial / "scans").mkdir(parents=True)
    jobs = [_Job(n, take.files[n], partial / "scans" / f"{n:06d}.ply", placement) for n in kept]
    written = sorted(number for number in run_jobs(_rewrite, jobs, workers=workers, label="correct") if number >= 0)
    _copy_companions(checked, partial)
    write_json(partial / "capture.json", _description(checked, written, partial))
    partial.rename(output)
    return output


def _unusable(checked: Checked) -> set[int]:
    frames = {
        number
        for finding in checked.verdict.findings
        if finding.code in UNUSABLE or finding.code.startswith("frame-")
        for number in finding.frames
    }
    take = checked.take
    return frames | {number for number, others in take.also.items() if not _all_equal(take, number, others)}


def _all_equal(take: TakeFolder, number: int, others: tuple[Path, ...]) -> bool:
    first = read_frame(take.files[number], number)
    for path in others:
        second = read_frame(path, number)
        if isinstance(first, BadFrame) or isinstance(second, BadFrame):
            return False
        if not np.array_equal(first.mesh.vertices, second.mesh.vertices):
            return False
    return True


def _rewrite(job: _Job) -> int:
    """The frame's number, or -1 where its file cannot be read."""
    found = read_frame(job.source, job.frame_id)
    if isinstance(found, BadFrame):
        return -1
    mesh = place(found.mesh, job.placement)
    faces = mesh.faces[:0] if found.estimated else mesh.faces  # what was guessed is not made a fact
    uv = mesh.uv if found.colours is None else None
    write_mesh(job.target, Mesh(mesh.vertices, faces, uv), colours=found.colours)
    return job.frame_id


def _copy_companions(checked: Checked, output: Path) -> None:
    """Motion capture, template and rig; a rig, poses, or a bare template, move as the scans they belong to."""
    take = checked.take
    assert checked.survey is not None
    placement = checked.survey.placement
    for source, name in ((take.body_path, "body.npz"), (take.path / "template.npz", "template.npz")):
        if source is not None and source.is_file():
            shutil.copyfile(source, output / name)
    if take.poses_path is not None:
        poses, lift = load_poses(take.poses_path), np.array([0, checked.survey.poses_lift_m, 0], np.float32)
        save_poses(output / "poses.npz", replace(poses, translations=poses.translations + lift))
    for bare in sorted(take.path.glob("template.*")):
        if bare.suffix.lower() in READABLE and bare.is_file():
            found = read_mesh(bare)
            # Whichever way the faces of the scans wind, its own have to look outwards in the end.
            own = replace(placement, flip=(outwardness(found.mesh) < 0) != placement.mirrors)
            sizes = None if own.flip else found.polygon_sizes
            name = bare.name if bare.suffix.lower() in WRITABLE else "template.ply"
            write_mesh(output / name, place(found.mesh, own), colours=found.colours, polygon_sizes=sizes)
    if take.rig is not None:
        factor = placement.scale / take.facts.declared
        save_rig(output / "rig.json", place_rig(take.rig, placement, scale=factor) if checked.rig_moves else take.rig)


def _description(checked: Checked, written: list[int], output: Path) -> dict[str, Any]:
    """What capture.json said, with what the command line said over it."""
    take = checked.take
    said = {entry: value for entry, value in take.description.items() if value is not None}
    description = {"format": 1, "name": take.path.resolve().name, **said, "units": "m", "frames": written}
    if take.claims.garment_colour:
        description["garment_colour"] = format_colour(parse_colour(take.claims.garment_colour))
    if take.claims.border_colours:
        description["boundary_colours"] = _named_borders(take, output, written)
    fps = take.facts.fps
    if any(finding.code == "fps" for finding in checked.verdict.findings) and checked.rate is not None:
        fps = checked.rate
    if fps is not None:
        description["fps"] = fps
    absent = ("frames-missing", "frames-listed")
    missing = {number for found in checked.verdict.findings if found.code in absent for number in found.frames}
    dropped = {*take.facts.dropped, *missing, *take.files} - set(written)
    return {**description, "dropped_frames": sorted(dropped)}


def _named_borders(take: TakeFolder, output: Path, written: list[int]) -> dict[str, str]:
    """Colours of the borders that the command line gives, by the names that they have, or else as learned ones get."""
    given = list(dict.fromkeys(format_colour(parse_colour(colour)) for colour in take.claims.border_colours))
    described: dict[str, str] = {}
    with contextlib.suppress(InputError):  # what was given over it was not judged
        said = parse_description({"boundary_colours": take.description.get("boundary_colours")}).boundary_colours
        described = {name: format_colour(colour) for name, colour in said.items()}
    if set(described.values()) == set(given):
        return described
    if len(given) == 1:
        return dict.fromkeys(template_loops(Capture(output, "", 1.0, tuple(written), None)) or ("border",), given[0])
    return {f"paint_{index}": colour for index, colour in enumerate(given)}
