"""What goes wrong in a capture lab, done to a sound take on purpose: one fault each, for tests of the preflight check.

Every function takes a take and returns a damaged one; nothing is written, and the take given stays as it is. Names are
the faults', not the findings': which finding names a fault is the benchmark's to say.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from benchmarks.plain_takes import PlainTake
from capture4d.captures.placement import Placement, place_rig
from capture4d.files.atomic import write_bytes, write_json
from capture4d.files.records import save_body, save_poses, save_rig
from capture4d.geometry.mesh import vertex_normals
from capture4d.mesh_files.meshes import write_mesh
from capture4d.mesh_files.ply import ply_bytes
from capture4d.types import Mesh, Scan

__all__ = [
    "bad_colours",
    "colourless",
    "drop_frames",
    "duplicate_number",
    "empty_frame",
    "flip_faces",
    "garment_paint",
    "move_scans",
    "nan_frame",
    "noisy",
    "other_poses",
    "partial_frame",
    "punctured",
    "recoloured",
    "repeat_frame",
    "scaled_frame",
    "truncated_frame",
    "turned",
    "with_rate",
    "without_companions",
    "write_take",
]

Y_TO_Z = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""A quarter turn that stands a Y up world on Z."""


def write_take(take: PlainTake, folder: Path) -> Path:
    """Write a take as a capture folder."""
    for frame_id, scan in take.scans.items():
        write_mesh(folder / "scans" / f"{frame_id:06d}.ply", scan.mesh, colours=scan.colours)
    if take.poses is not None:
        save_poses(folder / "poses.npz", take.poses)
    if take.body is not None:
        save_body(folder / "body.npz", take.body)
    if take.rig is not None:
        save_rig(folder / "rig.json", take.rig)
    hexadecimal = "#{:02x}{:02x}{:02x}".format
    write_json(
        folder / "capture.json",
        {
            "format": 1,
            "name": take.name,
            "fps": take.fps,
            "units": take.units,
            "garment_colour": hexadecimal(*take.garment_colour),
            "boundary_colours": {name: hexadecimal(*paint) for name, paint in take.boundary_colours.items()},
        },
    )
    for name, data in take.files.items():
        if data is None:
            (folder / name).unlink()
        else:
            write_bytes(folder / name, data)
    return folder


def _each_mesh(take: PlainTake, change: Callable[[Mesh, int], Mesh], frames: set[int] | None = None) -> PlainTake:
    """The take with some or all of its meshes changed; the vertices keep their number, and so do the colours."""
    scans = {
        number: scan if frames is not None and number not in frames else replace(scan, mesh=change(scan.mesh, number))
        for number, scan in take.scans.items()
    }
    return replace(take, scans=scans)


# --- coordinates -------------------------------------------------------------------------------------------------


def move_scans(
    take: PlainTake, transform: Float[np.ndarray, "3 3"], shift: tuple[float, float, float] = (0, 0, 0)
) -> PlainTake:
    """Another coordinate system for the scans, faces as they were: units, axes, a mirror, a floor."""
    offset = np.array(shift, np.float32)
    return _each_mesh(take, lambda mesh, _: mesh.with_vertices(mesh.vertices @ transform.T.astype(np.float32) + offset))


def turned(take: PlainTake) -> PlainTake:
    """Scans and rig with Z up."""
    moved = move_scans(take, Y_TO_Z)
    return moved if take.rig is None else replace(moved, rig=place_rig(take.rig, Placement(axes=Y_TO_Z)))


def flip_faces(take: PlainTake) -> PlainTake:
    return _each_mesh(take, lambda mesh, _: Mesh(mesh.vertices, np.ascontiguousarray(mesh.faces[:, ::-1])))


def without_companions(take: PlainTake) -> PlainTake:
    """Scans and nothing else: no motion capture, no rig."""
    return replace(take, poses=None, body=None, rig=None)


# --- frames ------------------------------------------------------------------------------------------------------


def drop_frames(take: PlainTake, frames: set[int]) -> PlainTake:
    return replace(take, scans={number: scan for number, scan in take.scans.items() if number not in frames})


def repeat_frame(take: PlainTake, frame: int) -> PlainTake:
    """A frame is the one before it over again."""
    numbers = list(take.scans)
    before = take.scans[numbers[numbers.index(frame) - 1]]
    return replace(take, scans={**take.scans, frame: replace(before, frame_id=frame)})


def duplicate_number(take: PlainTake, frame: int, other: int) -> PlainTake:
    """A second file, with another frame's scan, that bears a frame's number."""
    scan = take.scans[other]
    return replace(take, files={**take.files, f"scans/{frame:07d}.ply": ply_bytes(scan.mesh, scan.colours, None)})


def empty_frame(take: PlainTake, frame: int) -> PlainTake:
    """The reconstruction found nothing."""
    nothing = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    data = ply_bytes(nothing, np.zeros((0, 3), np.uint8), None)
    return replace(take, files={**take.files, f"scans/{frame:06d}.ply": data})


def truncated_frame(take: PlainTake, frame: int, share: float = 0.6) -> PlainTake:
    """The disk was full."""
    scan = take.scans[frame]
    data = ply_bytes(scan.mesh, scan.colours, None)
    return replace(take, files={**take.files, f"scans/{frame:06d}.ply": data[: int(share * len(data))]})


def nan_frame(take: PlainTake, frame: int, vertices: int = 20) -> PlainTake:
    """A few vertices are nowhere."""
    scan = take.scans[frame]
    data = bytearray(ply_bytes(scan.mesh, scan.colours, None))
    start = data.index(b"end_header\n") + len(b"end_header\n")
    for vertex in range(vertices):
        data[start + 15 * vertex : start + 15 * vertex + 4] = np.float32(np.nan).tobytes()
    return replace(take, files={**take.files, f"scans/{frame:06d}.ply": bytes(data)})


def partial_frame(take: PlainTake, frame: int, share: float = 0.5) -> PlainTake:
    """Cameras on one side dropped out."""
    scan = take.scans[frame]
    x = scan.mesh.vertices[:, 0]
    return replace(take, scans={**take.scans, frame: _kept(scan, x < np.quantile(x, share))})


def _kept(scan: Scan, keep: np.ndarray) -> Scan:
    faces = scan.mesh.faces[keep[scan.mesh.faces].all(axis=1)]
    return replace(scan, mesh=Mesh(scan.mesh.vertices, faces))


def scaled_frame(take: PlainTake, frame: int, factor: float = 1.1) -> PlainTake:
    """One frame was reconstructed with another calibration."""
    return _each_mesh(take, lambda mesh, _: mesh.with_vertices(mesh.vertices * np.float32(factor)), {frame})


def with_rate(take: PlainTake, factor: float, *, poses: bool) -> PlainTake:
    """A wrong frame rate in capture.json, and in the motion capture if that was told the same."""
    wrong = replace(take, fps=take.fps * factor)
    if poses and take.poses is not None:
        wrong = replace(wrong, poses=replace(take.poses, fps=take.poses.fps * factor))
    return wrong


# --- surface and colours -----------------------------------------------------------------------------------------


def noisy(take: PlainTake, spacings: float, seed: int = 0) -> PlainTake:
    """White noise along the normals, in median edge lengths."""

    def shake(mesh: Mesh, number: int) -> Mesh:
        rng = np.random.default_rng([seed, number])
        ends = mesh.vertices[mesh.faces[:, :2]]
        size = spacings * float(np.median(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)))
        offset = size * rng.standard_normal((len(mesh.vertices), 1))
        return mesh.with_vertices(
            (mesh.vertices + offset * vertex_normals(mesh.vertices, mesh.faces)).astype(np.float32)
        )

    return _each_mesh(take, shake)


def punctured(take: PlainTake, holes: int, radius_m: float, seed: int = 0) -> PlainTake:
    """Round holes all over the surface."""

    def puncture(scan: Scan) -> Scan:
        rng = np.random.default_rng([seed, scan.frame_id])
        vertices = scan.mesh.vertices
        keep = np.ones(len(vertices), bool)
        for centre in vertices[rng.choice(len(vertices), holes, replace=False)]:
            keep &= np.linalg.norm(vertices - centre, axis=1) > radius_m
        return _kept(scan, keep)

    return replace(take, scans={number: puncture(scan) for number, scan in take.scans.items()})


def bad_colours(take: PlainTake, *, share: float, level: float = 205.0) -> PlainTake:
    """Colours that keep a share of themselves; the rest is an even grey or white."""

    def fade(scan: Scan) -> Scan:
        faded = share * scan.colours.astype(np.float32) + (1 - share) * level
        return replace(scan, colours=np.clip(np.rint(faded), 0, 255).astype(np.uint8))

    return replace(take, scans={number: fade(scan) for number, scan in take.scans.items()})


def colourless(take: PlainTake) -> PlainTake:
    """Files with geometry only."""
    files = {f"scans/{number:06d}.ply": ply_bytes(scan.mesh, None, None) for number, scan in take.scans.items()}
    return replace(take, files={**take.files, **files})


def recoloured(
    take: PlainTake, before: tuple[int, int, int], after: tuple[int, int, int], reach: float = 30.0
) -> PlainTake:
    """What has about one colour (within `reach` of it in sRGB, shading apart) has another; shading stays."""
    was, will = np.array(before, np.float32), np.array(after, np.float32)

    def paint(scan: Scan) -> Scan:
        colours = scan.colours.astype(np.float32)
        shade = (colours @ was / (was @ was))[:, None]
        near = np.linalg.norm(colours - shade * was, axis=1) < reach * np.clip(shade[:, 0], 0.2, 1)
        painted = np.where(near[:, None], shade * will, colours)
        return replace(scan, colours=np.clip(np.rint(painted), 0, 255).astype(np.uint8))

    return replace(take, scans={number: paint(scan) for number, scan in take.scans.items()})


def garment_paint(
    take: PlainTake, *, garment: tuple[int, int, int] | None = None, border: tuple[int, int, int] | None = None
) -> PlainTake:
    """capture.json says other colours than the scans have."""
    paints = take.boundary_colours if border is None else dict.fromkeys(take.boundary_colours, border)
    return replace(take, garment_colour=garment or take.garment_colour, boundary_colours=paints)


# --- motion capture ----------------------------------------------------------------------------------------------


def other_poses(
    take: PlainTake,
    *,
    late: int = 0,
    shift: tuple[float, float, float] = (0, 0, 0),
    shape: tuple[float, ...] | None = None,
) -> PlainTake:
    """Motion capture that is late by some frames, beside the subject, or of somebody else."""
    assert take.poses is not None, "the take has no motion capture"
    poses = replace(
        take.poses,
        rotations=np.roll(take.poses.rotations, late, axis=0),
        translations=np.roll(take.poses.translations, late, axis=0) + np.array(shift, np.float32),
    )
    if shape is not None:
        poses = replace(poses, shape=np.array(shape, np.float32))
    return replace(take, poses=poses)
