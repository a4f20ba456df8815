"""SMPL-family bodies from the user's own licensed files, turned into this project's plain arrays once.

SMPL, SMPL+H and SMPL-X are distributed to registered users as .npz or .pkl. A pickle can run code when it is loaded;
this reader runs none of it, and builds nothing that the file names (see `capture4d.body.pickled_arrays`).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from capture4d.body.pickled_arrays import read_pickled_arrays
from capture4d.errors import InputError
from capture4d.files.arrays import ArrayFile
from capture4d.files.reading import reading
from capture4d.files.records import save_body
from capture4d.types import Body, Mesh

__all__ = ["convert_smpl", "read_smpl"]

SMPL_JOINTS = [
    "pelvis",
    "left_hip",
    "right_hip",
    "spine1",
    "left_knee",
    "right_knee",
    "spine2",
    "left_ankle",
    "right_ankle",
    "spine3",
    "left_foot",
    "right_foot",
    "neck",
    "left_collar",
    "right_collar",
    "head",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
    "left_hand",
    "right_hand",
]
SHARED_JOINTS = 22
"""The first joints of the whole family; then come hands, and in SMPL-X jaw and eyes before them."""
MAX_SHAPES = 16
"""The strongest components, which come first."""


def convert_smpl(source: Path, output: Path) -> None:
    """Convert an SMPL-family file (.npz or .pkl) to a body file of this project (.npz).

    Raises:
        InputError: not a body of this family; the message names the file and what is missing.
    """
    save_body(output, read_smpl(source))


def read_smpl(source: Path) -> Body:
    """Read an SMPL-family body.

    Raises:
        InputError: the file is missing, holds anything but arrays, or lacks a part of the model.
    """
    with reading(source, "body of the SMPL family", absent="no such body file"):
        return _assemble(_read_fields(source))


def _read_fields(source: Path) -> dict[str, np.ndarray]:
    match source.suffix.lower():
        case ".npz":
            with ArrayFile(source) as arrays:
                found = arrays.numbers()
        case ".pkl":
            found = read_pickled_arrays(source)
        case other:
            raise InputError(f"expected an .npz or .pkl file, found '{other}'")
    needed = ("v_template", "shapedirs", "J_regressor", "weights", "kintree_table", "f")
    missing = [name for name in needed if name not in found]
    if missing:
        raise InputError(f"expected an SMPL-family body, found no {', '.join(missing)}")
    return found


def _assemble(fields: dict[str, np.ndarray]) -> Body:
    template = np.asarray(fields["v_template"], np.float64)
    shapes = np.moveaxis(np.asarray(fields["shapedirs"], np.float64), 2, 0)[:MAX_SHAPES]
    regressor = np.asarray(fields["J_regressor"], np.float64)
    parents = np.asarray(fields["kintree_table"])[0].astype(np.int64)
    parents[0] = -1
    posedirs = fields.get("posedirs")
    pose_directions = None
    if posedirs is not None:
        directions = np.asarray(posedirs, np.float64)
        directions = directions if directions.ndim == 3 else directions.reshape(*template.shape, -1)
        pose_directions = np.moveaxis(directions, 2, 0).astype(np.float32)
        if len(pose_directions) != 9 * (len(parents) - 1):
            found = len(pose_directions)
            raise InputError(f"expected {9 * (len(parents) - 1)} posedirs for {len(parents)} joints, found {found}")
    return Body(
        template=Mesh(template.astype(np.float32), np.asarray(fields["f"]).astype(np.int32)),
        shape_directions=shapes.astype(np.float32),
        joints=(regressor @ template).astype(np.float32),
        joint_directions=np.einsum("jv,svc->sjc", regressor, shapes).astype(np.float32),
        joint_names=_joint_names(len(parents)),
        parents=parents.astype(np.int32),
        skin_weights=np.asarray(fields["weights"]).astype(np.float32),
        pose_directions=pose_directions,
    )


def _joint_names(count: int) -> tuple[str, ...]:
    """SMPL's, as far as the family shares them."""
    if count == len(SMPL_JOINTS):
        return tuple(SMPL_JOINTS)
    shared = SMPL_JOINTS[: min(SHARED_JOINTS, count)]
    return (*shared, *(f"joint_{joint:02d}" for joint in range(len(shared), count)))
