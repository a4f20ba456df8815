"""`capture4d check --fix`: the take again, without what is safely repaired. The original is only read.

Where scans have to move they are rewritten in metres, Y up, faces outside, feet on the floor; so are those of which
something could not be used, without it. All others are hard links to the originals, which cost no space, or copies
where the file system has no links between the two folders. Bare templates and poses move as the scans do; frames that
cannot be used are left out and named in capture.json as dropped. Frame numbers stay: a frame's time follows from its
number. What needs a person's judgement (paint, light, calibration, other people's poses) stays as it is.

The folder is there once it is whole. Until then its files lie in a hidden folder beside it; the same command, killed
and repeated, writes those that are missing.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from capture4d.captures.capture import Capture
from capture4d.captures.description import parse_description
from capture4d.captures.placement import Placement, place, place_rig
from capture4d.captures.take_colours import template_loops
from capture4d.colours.spaces import format_colour, parse_colour
from capture4d.errors import InputError
from capture4d.files.atomic import read_json, write_json
from capture4d.files.records import load_poses, save_poses, save_rig
from capture4d.mesh_files.meshes import READABLE, WRITABLE, read_mesh, write_mesh
from capture4d.preflight.check import Checked
from capture4d.preflight.facts import BadFrame
from capture4d.preflight.statistics import outwardness
from capture4d.preflight.take_folder import TakeFolder, read_frame
from capture4d.runs.workers import run_jobs
from capture4d.types import Mesh
from capture4d.units import METRES

__all__ = ["Fixed", "fixed_path", "require_place", "write_fixed"]

UNUSABLE = ("frame-partial", "frame-repeated", "scale-jump", "poses-missing")
"""Findings whose frames are left out; frames that cannot be read are left out anyway."""
COMPANIONS = (".mtl", ".bin", ".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".tga")
"""What may lie beside scans or in folders below, and belongs to them: materials, buffers, textures."""
RECORD = "fix.json"
"""What the unfinished folder is being made of."""
How = Literal["rewritten", "linked", "copied", "unreadable"]


@dataclass(frozen=True, slots=True)
class Fixed:
    """A corrected take."""

    path: Path
    rewritten: int
    """Scans that are files of their own, changed."""
    linked: int
    """Scans that are the originals under another name."""
    copied: int
    """Scans that are copies, where the file system has no links between the folders."""

    def told(self) -> str:
        """In words: how many scans are the originals, how many new."""
        counts = (("rewritten", self.rewritten), ("linked to the originals", self.linked), ("copied", self.copied))
        return "scans: " + ", ".join(f"{count} {how}" for how, count in counts if count)


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    frame_id: int
    source: Path
    target: Path
    placement: Placement | None
    """None: the file stays as it is."""


def fixed_path(capture: Path) -> Path:
    """Where the corrected take goes unless told otherwise: next to the original."""
    capture = capture.resolve()
    return capture.parent / f"{capture.name}-fixed"


def require_place(output: Path, capture: Path) -> None:
    """See that a corrected take can be written, before anything is looked at.

    Raises:
        InputError: there is something already, or the place lies within the take.
    """
    if output.exists() or output.is_symlink():
        raise InputError("already there, expected to write the corrected take there; remove it first", where=output)
    if output.resolve().is_relative_to(capture.resolve()):
        raise InputError("expected a folder outside the take, found one within it", where=output)
    above = next((each for each in output.resolve().parents if each.exists()), output)
    if not above.is_dir() or not os.access(above, os.W_OK):
        raise InputError("expected a folder that can be written to, found none", where=above)


def write_fixed(checked: Checked, output: Path | None = None, *, workers: int = 1) -> Fixed:
    """Write the corrected take; the new folder. It is there whole or not at all.

    Args:
        output: that folder; `fixed_path` if None.

    Raises:
        InputError: the folder exists, or no frame is left.
    """
    take, output = checked.take, output or fixed_path(checked.take.path)
    require_place(output, take.path)
    if checked.survey is None:
        raise InputError("no readable frame, nothing to correct", where=take.path)
    unusable = _unusable(checked)
    kept = [number for number in take.files if number not in unusable]
    if not kept:
        raise InputError("no usable frame, nothing to correct", where=take.path)
    partial = output.with_name(f".{output.name}.partial")
    done = _continued(partial, checked, kept)
    jobs = [job for job in _jobs(checked, kept, partial / "scans") if job.frame_id not in done]
    count = Counter(done.values())
    written = sorted(done)
    for number, how in run_jobs(_write, jobs, workers=workers, label="correct"):
        count[how] += 1
        if how != "unreadable":
            written.append(number)
    _copy_companions(checked, partial)
    write_json(partial / "capture.json", _description(checked, sorted(written), partial))
    (partial / RECORD).unlink()
    partial.rename(output)
    return Fixed(output, count["rewritten"], count["linked"], count["copied"])


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


# --- scans -------------------------------------------------------------------------------------------------------


def _moves(checked: Checked) -> bool:
    """Scans are not where, or not in the unit, that the take says."""
    assert checked.survey is not None
    placement = checked.survey.placement
    return placement.moves or placement.scale != checked.take.facts.declared


def _jobs(checked: Checked, kept: list[int], folder: Path) -> list[_Job]:
    """What is written, under names that are the frames' numbers."""
    take = checked.take
    assert checked.survey is not None
    in_part = {number for each in checked.verdict.findings if each.code == "read-in-part" for number in each.frames}
    placement, moves = checked.survey.placement, _moves(checked)
    still = Placement(1.0)
    jobs = []
    for number in kept:
        source = take.files[number]
        changed = moves or number in in_part
        suffix = ".ply" if changed else source.suffix.lower()
        how = None if not changed else placement if moves else still
        jobs.append(_Job(number, source, folder / f"{number:06d}{suffix}", how))
    return jobs


def _continued(partial: Path, checked: Checked, kept: list[int]) -> dict[int, How]:
    """Open the unfinished folder; the frames that a run before, killed meanwhile, has written.

    What was made of other scans, or is to be moved otherwise, is thrown away.
    """
    assert checked.survey is not None
    placement = checked.survey.placement
    jobs = _jobs(checked, kept, partial / "scans")
    record = {
        "scale": placement.scale,
        "axes": placement.axes.tolist(),
        "flip": placement.flip,
        "lift_m": placement.lift_m,
        "scans": {job.target.name: _told_apart(job.source) for job in jobs},
    }
    path = partial / RECORD
    with contextlib.suppress(InputError, OSError):
        if path.is_file() and read_json(path) == record:
            return {job.frame_id: _earlier(job) for job in jobs if job.target.is_file()}
    if partial.exists():
        shutil.rmtree(partial)
    (partial / "scans").mkdir(parents=True)
    if any(job.placement is None for job in jobs):
        _link_companions(checked.take, partial / "scans")
    write_json(path, record)
    return {}


def _told_apart(scan: Path) -> list[str | int]:
    """What another scan would not have, as far as can be told without reading it."""
    found = scan.stat()
    return [scan.name, found.st_size, found.st_mtime_ns]


def _earlier(job: _Job) -> How:
    if job.placement is not None:
        return "rewritten"
    return "linked" if job.target.samefile(job.source) else "copied"


def _write(job: _Job) -> tuple[int, How]:
    """Write one frame; its number, and how."""
    if job.placement is None:
        return job.frame_id, _linked(job.source, job.target)
    found = read_frame(job.source, job.frame_id)
    if isinstance(found, BadFrame):
        return job.frame_id, "unreadable"
    mesh = place(found.mesh, job.placement)
    faces = mesh.faces[:0] if found.estimated else mesh.faces  # what was guessed is not made a fact
    uv = mesh.uv if found.colours is None else None
    write_mesh(job.target, Mesh(mesh.vertices, faces, uv), colours=found.colours)
    return job.frame_id, "rewritten"


def _linked(source: Path, target: Path) -> How:
    """The file under another name; a copy where the file system cannot, which is whole or not there."""
    source = source.resolve()
    try:
        os.link(source, target)
    except OSError:
        unfinished = target.with_name(f".{target.name}.partial")
        shutil.copyfile(source, unfinished)
        unfinished.replace(target)
        return "copied"
    return "linked"


def _link_companions(take: TakeFolder, folder: Path) -> None:
    """Materials, buffers and textures, where the scans look for them."""
    origin = take.path / "scans" if (take.path / "scans").is_dir() else take.path
    for path in sorted(origin.rglob("*")):
        if path.suffix.lower() not in COMPANIONS or not path.is_file():
            continue
        target = folder / path.relative_to(origin)
        target.parent.mkdir(parents=True, exist_ok=True)
        _linked(path, target)


# --- what lies beside them ---------------------------------------------------------------------------------------


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
            if not _moves(checked):
                own = replace(own, scale=1.0)  # its unit is that of the scans, which stays
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
    declared = next(unit for unit, metres in METRES.items() if metres == take.facts.declared)
    units = "m" if _moves(checked) else declared
    description = {"format": 1, "name": take.path.resolve().name, **said, "units": units, "frames": written}
    if take.claims.garment_colour:
        description["garment_colour"] = format_colour(parse_colour(take.claims.garment_colour))
    if take.claims.border_colours:
        description["boundary_colours"] = _named_borders(take, output, written)
    elif len(take.facts.paints.borders) == 1 and _found(checked, "borders-named"):
        paint = format_colour(take.facts.paints.borders[0])
        description["boundary_colours"] = dict.fromkeys(take.facts.template_loops or (), paint)
    fps = take.facts.fps
    if _found(checked, "fps") and checked.rate is not None:
        fps = checked.rate
    if fps is not None:
        description["fps"] = fps
    absent = ("frames-missing", "frames-listed")
    missing = {number for found in checked.verdict.findings if found.code in absent for number in found.frames}
    dropped = {*take.facts.dropped, *missing, *take.files} - set(written)
    return {**description, "dropped_frames": sorted(dropped)}


def _found(checked: Checked, code: str) -> bool:
    return any(finding.code == code for finding in checked.verdict.findings)


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
