"""Files in, template out: a garment mesh and the body it lies on, or a part of that body."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from capture4d.body.anny import load_anny
from capture4d.body.motion_files import read_motion
from capture4d.body.skinning import PosedBody, pose_frame, with_pose, with_shape
from capture4d.errors import InputError
from capture4d.files.meshes import read_mesh
from capture4d.files.records import load_body, save_garment
from capture4d.templates.body_regions import Region, body_region
from capture4d.templates.garment import TemplateReport, UvChoice, make_template, weld
from capture4d.types import Body, Garment
from capture4d.units import METRES, Units

__all__ = ["run"]


def run(
    mesh: Path | None,
    output: Path,
    *,
    body: Path | None = None,
    poses: Path | None = None,
    frame: int | None = None,
    region: Region | None = None,
    uv: UvChoice = "auto",
    names: Sequence[str] = (),
    units: Units = "m",
) -> tuple[Garment, TemplateReport]:
    """Write a template.

    Args:
        mesh: garment mesh on the body; None with a `region`.
        body: body.npz; the built-in one if None.
        poses: motion file that holds the pose and the shape in which the garment lies on the body; None is the rest
            pose of the mean shape.
        frame: frame of `poses`, by its number; the first if None.
        region: part of the body to take as the garment instead of a mesh.
    Raises:
        InputError: a file is missing or damaged, or the mesh cannot be a template.
    """
    if output.suffix.lower() != ".npz":
        raise InputError(f"expected a template file .npz, found '{output.suffix}'", where=output)
    if (mesh is None) == (region is None):
        raise InputError(f"template: expected a mesh or --region, found {'neither' if mesh is None else 'both'}")
    wearer = load_body(body) if body else load_anny()
    posed = _posed(wearer, poses, frame)
    if mesh is None:
        assert region is not None
        shape = posed.shaped.shape
        posed = _at_rest(wearer, shape)
        surface, source = body_region(posed.shaped, region), f"region {region}"
    else:
        surface, source = read_mesh(mesh).mesh, str(mesh)
        surface = surface.with_vertices(surface.vertices * np.float32(METRES[units]))
        surface = weld(surface) if mesh.suffix.lower() == ".glb" else surface
    garment, report = make_template(surface, posed, uv=uv, names=names, source=source)
    save_garment(output, garment)
    return garment, report


def _posed(body: Body, poses: Path | None, frame: int | None) -> PosedBody:
    if poses is None:
        return _at_rest(body, np.zeros(0, np.float32))
    motion = read_motion(poses, body)
    try:
        row = 0 if frame is None else motion.row(frame)
    except InputError as error:
        raise error.at(poses) from error
    return pose_frame(with_shape(body, motion.shape), motion, row)


def _at_rest(body: Body, shape: np.ndarray) -> PosedBody:
    identity = np.repeat(np.eye(3)[None], len(body.joint_names), axis=0)
    return with_pose(with_shape(body, shape), identity, np.zeros(3))
