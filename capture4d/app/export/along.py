"""What goes along with a garment when it is asked for: the body that moved it, its motion, and the take's scans."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from capture4d.app.export.clip import Clip
from capture4d.app.export.config import Along
from capture4d.app.export.skeleton import Skeleton
from capture4d.body.skinning import ShapedBody, pose_frame, with_shape
from capture4d.captures.capture import read_scan, write_scan
from capture4d.captures.work_folder import WorkFolder
from capture4d.errors import InputError
from capture4d.mesh_files.animated.moving_mesh import MovingMesh
from capture4d.mesh_files.meshes import read_mesh
from capture4d.motions.motion_files import read_motion, write_motion
from capture4d.types import PoseSequence

__all__ = ["BODY", "MOTION", "body_clip", "require_along", "write_body_motion", "write_scans"]

BODY, MOTION, SCANS = "body", "body.bvh", "scans"
_GREY = (0.35, 0.33, 0.32)
"""Linear colour of the body: that of no cloth."""
_MOTION_AGREES_MM = 0.1
"""By how much joints of a motion that is read back may be off: a bvh has four decimals of a degree."""


def require_along(work: WorkFolder, along: Sequence[Along]) -> None:
    """
    Raises:
        InputError: there are no scans, or no body, to go along.
    """
    if "scans" in along and work.is_animated:
        raise InputError("--with scans: expected a take with scans, found an animation", where=work.path)
    if "body" in along and work.posed_body is None:
        raise InputError("--with body: expected a body that moved the garment, found none", where=work.path)


def body_clip(work: WorkFolder, garment: Clip) -> Clip:
    """The body in the frames of a garment, skinned and with all its joints."""
    person, poses = _person(work, garment)
    body = person.body
    moving = MovingMesh(
        body.template.with_vertices(next(_frames(person, poses))),
        garment.moving.frame_ids,
        garment.moving.fps,
        partial(_frames, person, poses),
    )
    return Clip(moving, Skeleton.create(person, poses, body.skin_weights), None, None, (), name=BODY, colour=_GREY)


def _person(work: WorkFolder, garment: Clip) -> tuple[ShapedBody, PoseSequence]:
    body, poses = work.require_posed_body()
    return with_shape(body, poses.shape), poses.of_frames(garment.moving.frame_ids)


def _frames(person: ShapedBody, poses: PoseSequence) -> Iterator[np.ndarray]:
    for row in range(len(poses.frame_ids)):
        yield pose_frame(person, poses, row).vertices().astype(np.float32)


def write_body_motion(path: Path, work: WorkFolder, garment: Clip) -> None:
    """Write the motion as a bvh file, and read it back.

    Raises:
        InputError: its joints are elsewhere.
    """
    person, poses = _person(work, garment)
    write_motion(path, person.body, poses)
    found, largest = read_motion(path, person.body), 0.0
    if len(found.frame_ids) != len(poses.frame_ids):
        raise InputError(f"read back: expected {len(poses.frame_ids)} frames, found {len(found.frame_ids)}", where=path)
    for row in range(len(poses.frame_ids)):
        apart = pose_frame(person, poses, row).transforms - pose_frame(person, found, row).transforms
        joints = np.einsum("jab,jb->ja", apart[:, :3, :3], person.joints) + apart[:, :3, 3]
        largest = max(largest, 1000 * float(np.linalg.norm(joints, axis=1).max()))
    if not largest <= _MOTION_AGREES_MM:
        raise InputError(f"read back: expected joints within {_MOTION_AGREES_MM} mm, found {largest:.3f}", where=path)


def write_scans(folder: Path, work: WorkFolder, frame_ids: Sequence[int]) -> list[int]:
    """Write the scan of each frame that has none yet, as a coloured ply in metres, and read it back.

    Returns:
        Frames whose scan is damaged or not there any more.
    """
    lost = []
    for frame_id in frame_ids:
        path = folder / SCANS / f"{frame_id:06d}.ply"
        if path.is_file():
            continue
        try:
            scan = read_scan(work.capture, frame_id)
        except InputError:
            lost.append(frame_id)
            continue
        write_scan(path, scan)
        if not np.array_equal(read_mesh(path).mesh.vertices, scan.mesh.vertices):
            raise InputError("read back: expected the vertices that were written, found others", where=path)
    return lost
