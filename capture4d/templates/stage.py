"""Files in, template out: a garment mesh and the body it lies on, or a part of that body."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from capture4d.body.anny import load_anny
from capture4d.body.skinning import PosedBody, pose_frame, with_pose, with_shape
from capture4d.captures.placement import place
from capture4d.errors import InputError
from capture4d.files.atomic import file_digest
from capture4d.files.records import load_body, save_garment
from capture4d.mesh_files.meshes import read_mesh
from capture4d.motions.motion_files import read_motion, told
from capture4d.runs.stage import StageResult
from capture4d.templates.body_regions import body_region
from capture4d.templates.cage_files import read_cage
from capture4d.templates.config import TEMPLATE, TemplateConfig
from capture4d.templates.garment import TemplateReport, make_template
from capture4d.templates.placing import Placed, find_placement
from capture4d.types import Body, Garment

__all__ = ["TemplateResult", "run"]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class TemplateResult(StageResult):
    """A template that was written, and what was found on the way."""

    garment: Garment
    report: TemplateReport
    notes: tuple[str, ...] = ()
    """What in the mesh's file could not be used."""
    placed: Placed | None = None
    """In what unit the mesh is, and with which axes; None of a region of the body."""


def run(
    mesh: Path | None,
    output: Path,
    config: TemplateConfig = TEMPLATE,
    *,
    body: Path | None = None,
    poses: Path | None = None,
    cage: Path | None = None,
) -> TemplateResult:
    """Write a template. It is one file and takes seconds: there is nothing to resume, and no record of it.

    Args:
        mesh: garment mesh on the body; None with `config.region`.
        output: template.npz; replaced if it is there.
        body: body.npz; the built-in one if None.
        poses: motion file that holds the pose and the shape in which the garment lies on the body; None is the rest
            pose of the mean shape.
        cage: curves along which the mesh is shrunk onto the body, as `read_cage` has them; found if None.
    Raises:
        InputError: a file is missing or damaged, or the mesh cannot be a template.
    """
    if output.suffix.lower() != ".npz":
        raise InputError(f"expected a template file .npz, found '{output.suffix}'", where=output)
    if (mesh is None) == (config.region is None):
        raise InputError(f"template: expected a mesh or --region, found {'neither' if mesh is None else 'both'}")
    if cage is not None and (mesh is None or not config.wrap):
        raise InputError("template: expected --wrap and a mesh beside --cage, found it without")
    marks = read_cage(cage) if cage else None
    wearer = load_body(body) if body else load_anny()
    posed = _posed(wearer, poses, config.pose_frame)
    placed = None
    if mesh is None:
        assert config.region is not None
        posed = _at_rest(wearer, posed.shaped.shape)
        surface, source, notes = body_region(posed.shaped, config.region), f"region {config.region}", ()
    else:
        found = read_mesh(mesh)
        surface, source, notes = found.mesh, str(mesh), found.notes
        placed = find_placement(surface, posed, units=config.mesh_units, up=config.up)
        surface = place(surface, placed.placement)
    garment, report = make_template(
        surface,
        posed,
        uv=config.uv,
        uv_is_pattern=config.uv_is_pattern,
        follow=config.follow,
        names=config.loop_names,
        wrap=config.wrap if marks is None else marks,
        source=source,
    )
    save_garment(output, garment)
    return TemplateResult(
        output, file_digest([output], root=output.parent), garment=garment, report=report, notes=notes, placed=placed
    )


def _posed(body: Body, poses: Path | None, frame: int | None) -> PosedBody:
    if poses is None:
        return _at_rest(body, np.zeros(0, np.float32))
    motion = read_motion(poses, body, say=told(poses))
    try:
        row = 0 if frame is None else motion.row(frame)
    except InputError as error:
        raise error.at(poses) from error
    return pose_frame(with_shape(body, motion.shape), motion, row)


def _at_rest(body: Body, shape: np.ndarray) -> PosedBody:
    identity = np.repeat(np.eye(3)[None], len(body.joint_names), axis=0)
    return with_pose(with_shape(body, shape), identity, np.zeros(3))
