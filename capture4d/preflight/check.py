"""Looking through a take before a night is spent on it.

Two passes. A few frames tell the coordinates (`capture4d.preflight.survey`); then frames are streamed, two in memory
at a time, and become a few numbers each (`capture4d.preflight.statistics`), and `capture4d.preflight.verdict` judges.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from capture4d.cameras.coverage import camera_counts
from capture4d.captures.placement import Placement, place, place_rig
from capture4d.captures.scan_files import Surface
from capture4d.colours.labels import OTHER, classify_colours
from capture4d.preflight.facts import BadFrame, Paints
from capture4d.preflight.findings import Verdict
from capture4d.preflight.mannequin import sample_surface
from capture4d.preflight.motion import Motion
from capture4d.preflight.statistics import FrameStatistics, measure_frame, surface_shift
from capture4d.preflight.survey import Survey, survey_take
from capture4d.preflight.take_folder import (
    CapturedMotion,
    Claims,
    TakeFolder,
    load_motion,
    open_take,
    read_frame,
    time_stamp,
)
from capture4d.preflight.verdict import judge, true_rate
from capture4d.runs.workers import run_jobs
from capture4d.types import Mesh, Rig, Scan

__all__ = ["Checked", "check_take"]

PROBES = 4
PAIRS = 30
"""Pairs of consecutive frames that a sample holds."""
SUSPECTS = 60
"""Files of odd sizes that a sample holds beyond that."""
RUN = 16
"""Frames of a job."""


@dataclass(frozen=True, slots=True, eq=False)
class Checked:
    """A take that was looked through."""

    take: TakeFolder
    survey: Survey | None
    verdict: Verdict
    frames: int
    """Looked at."""
    rig_moves: bool
    """The rig is in the coordinates of the scans, whatever those are."""
    rate: float | None
    """Frames a second by motion capture or time stamps."""
    fixed: Path | None = None
    """Folder of the corrected take, if there is one."""
    how_fixed: str = ""
    """How many of its scans are the originals, and how many new."""


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    """A run of consecutive frames."""

    files: tuple[tuple[int, Path], ...]
    before: tuple[int, Path] | None


@dataclass(frozen=True, slots=True, eq=False)
class _Measures:
    """What every frame is measured with."""

    placement: Placement
    paints: Paints
    rig: Rig | None
    motion: CapturedMotion | None
    poses_lift_m: float


def check_take(path: Path, claims: Claims | None = None, *, all_frames: bool = False, workers: int = 1) -> Checked:
    """Look through a take.

    Raises:
        InputError: there is nothing to look at, or a description, rig or body cannot be read.
    """
    take = open_take(path, claims)
    motion = load_motion(take.poses_path, take.body_path) if take.poses_path is not None and take.moving else None
    survey = _survey(take, motion)
    placement = Placement(take.facts.declared) if survey is None else survey.placement
    rig, rig_moves = take.rig, False
    if survey is not None and take.rig is not None:
        rig, rig_moves = _rig_of_scans(take, placement)
    chosen = list(take.files) if all_frames else _sample(take)
    lift = 0.0 if survey is None else survey.poses_lift_m
    frames: list[FrameStatistics] = []
    bad: list[BadFrame] = []
    for statistics, unreadable in run_jobs(
        _measure_run,
        _jobs(take, chosen),
        prepare=partial(_Measures, placement, take.facts.paints, rig, motion, lift),
        workers=workers,
        label="Checking",
        units=lambda job: len(job.files),
    ):
        frames += statistics
        bad += unreadable
    verdict = judge(take.facts, survey, frames, bad)
    return Checked(
        take,
        survey,
        verdict,
        len(chosen),
        rig_moves,
        true_rate(take.facts, sorted(frames, key=lambda frame: frame.frame_id)),
    )


def _survey(take: TakeFolder, motion: CapturedMotion | None) -> Survey | None:
    """Coordinates from the first readable frames of equal parts of the take."""
    posed = set() if motion is None else set(motion.rows)
    known = [number for number in take.files if not posed or number in posed]
    candidates = known or list(take.files)
    probes: list[tuple[int, Surface]] = []
    for part in np.array_split(np.array(candidates), min(PROBES, len(candidates))):
        for number in part[:20].tolist():
            found = read_frame(take.files[number], number)
            if not isinstance(found, BadFrame):
                probes.append((number, found))
                break
    if not probes:
        return None
    return survey_take([found.mesh for _, found in probes], take.facts.declared, _probe_motion(take, motion, probes))


def _probe_motion(
    take: TakeFolder, motion: CapturedMotion | None, probes: Sequence[tuple[int, Surface]]
) -> Motion | None:
    """Motion capture in the probe frames, and what of them is not the garment."""
    if motion is None:
        return None
    states = [motion.state(number) for number, _ in probes]
    posed = [state for state in states if state is not None]
    if len(posed) < len(probes):
        return None
    bare = [_bare(found, take.facts.paints) for _, found in probes]
    known = all(mesh is not None for mesh in bare)
    meshes = [mesh for mesh in bare if mesh is not None] if known else [found.mesh for _, found in probes]
    return Motion(motion.model(), posed, meshes, known)


def _bare(found: Surface, paints: Paints) -> Mesh | None:
    """What of a scan is neither garment nor paint; None if that cannot be told, or is next to nothing."""
    if found.colours is None or paints.garment is None:
        return None
    labels = classify_colours(found.colours, paints.garment, paints.borders)
    bare = (labels[found.mesh.faces] == OTHER).all(axis=1)
    return Mesh(found.mesh.vertices, found.mesh.faces[bare]) if 0.1 < bare.mean() < 0.98 else None


def _rig_of_scans(take: TakeFolder, placement: Placement) -> tuple[Rig, bool]:
    """The rig in metres with Y up, and whether it had to be moved there: the one that looks at the scan."""
    assert take.rig is not None
    factor = placement.scale / take.facts.declared
    if not placement.moves and factor == 1:
        return take.rig, False
    found = next(
        found
        for number, file in take.files.items()
        if not isinstance(found := read_frame(file, number), BadFrame)
    )  # fmt: skip
    as_is = sample_surface(found.mesh)[:, :3] * take.facts.declared
    placed = sample_surface(place(found.mesh, placement))[:, :3]
    if camera_counts(take.rig, placed).mean() >= camera_counts(take.rig, as_is).mean() or placement.mirrors:
        return take.rig, False
    return place_rig(take.rig, placement, scale=factor), True


def _sample(take: TakeFolder) -> list[int]:
    """Pairs of consecutive frames all along the take, and files whose size is odd."""
    numbers = list(take.files)
    if len(numbers) <= 2 * PAIRS:
        return numbers
    starts = np.linspace(0, len(numbers) - 2, PAIRS).astype(int)
    chosen = {int(index) for start in starts for index in (start, start + 1)}
    size = np.array([file.stat().st_size for file in take.files.values()])
    small = np.flatnonzero(size < 0.5 * np.median(size))
    same = np.flatnonzero(np.diff(size) == 0)
    # Scans of one topology all have one size, which says nothing.
    if len(same) > 0.1 * len(size):
        same = same[:0]
    for index in small[:SUSPECTS].tolist():
        chosen.add(index)
    for index in same[: SUSPECTS // 2].tolist():
        chosen |= {index, index + 1}
    return [numbers[index] for index in sorted(chosen)]


def _jobs(take: TakeFolder, chosen: Sequence[int]) -> list[_Job]:
    """Runs of consecutive frames; each knows the frame before it, so that where runs end does not matter."""
    index = {number: place for place, number in enumerate(take.files)}
    numbers = list(take.files)
    runs: list[list[int]] = []
    for number in chosen:
        if runs and len(runs[-1]) < RUN and index[number] == index[runs[-1][-1]] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    wanted = set(chosen)
    jobs = []
    for run in runs:
        before = numbers[index[run[0]] - 1] if index[run[0]] else None
        jobs.append(
            _Job(
                files=tuple((number, take.files[number]) for number in run),
                before=None if before is None or before not in wanted else (before, take.files[before]),
            )
        )
    return jobs


def _measure_run(measures: _Measures, job: _Job) -> tuple[list[FrameStatistics], list[BadFrame]]:
    statistics: list[FrameStatistics] = []
    bad: list[BadFrame] = []
    before: tuple[int, Mesh] | None = None
    if job.before is not None:
        number, file = job.before
        found = read_frame(file, number)
        before = None if isinstance(found, BadFrame) else (number, place(found.mesh, measures.placement))
    for number, file in job.files:
        found = read_frame(file, number)
        if isinstance(found, BadFrame):
            bad.append(found)
            before = None
            continue
        mesh = place(found.mesh, measures.placement)
        colours = found.colours
        if colours is not None and (colours == colours[0]).all():
            colours = None
        filler = np.zeros((len(mesh.vertices), 3), np.uint8)
        scan = Scan(mesh, filler if colours is None else colours, number, 0.0)
        body = None if measures.motion is None else measures.motion.surface(number)
        if body is not None:
            body = body + np.array([0, measures.poses_lift_m, 0])
        frame = measure_frame(scan, measures.paints, rig=measures.rig, body=body, has_colours=colours is not None)
        frame = replace(frame, time_s=time_stamp(file), estimated=found.estimated)
        frame = replace(frame, notes=tuple(f"{file}: {note}" for note in found.notes))
        if before is not None:
            frame = replace(frame, shift_m=surface_shift(before[1], mesh), shift_from=before[0])
        statistics.append(frame)
        before = number, mesh
    return statistics, bad
