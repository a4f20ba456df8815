"""SMPL-family bodies from the user's own licensed files, turned into this project's plain arrays once.

SMPL, SMPL+H and SMPL-X are distributed to registered users as .npz or .pkl. A pickle can run code when it is loaded;
this reader runs none of it, and builds nothing that the file names (see `capture4d.body.pickled_arrays`). Relatives of
theirs come in the same layout and mean something else by it (STAR's pose blendshapes), or are no whole bodies (MANO's
hands, FLAME's heads); they are told by their arrays and refused by their names.
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
    if any(name.startswith(("skel_", "skin_template", "osim")) or "osim" in name for name in found):
        raise InputError(f"expected {_FAMILY}, found SKEL, whose joints are others")
    needed = ("v_template", "shapedirs", "J_regressor", "weights", "kintree_table", "f")
    missing = [name for name in needed if name not in found]
    if missing:
        raise InputError(f"expected an SMPL-family body, found no {', '.join(missing)}")
    return found


def _assemble(fields: dict[str, np.ndarray]) -> Body:
    template = _array(fields, "v_template", (None, 3))
    verts = len(template)
    parents = _parents(fields["kintree_table"])
    joints = len(parents)
    directions = _pose_directions(fields.get("posedirs"), verts, joints)
    _require_known(joints)
    shapes = np.moveaxis(_array(fields, "shapedirs", (verts, 3, None)), 2, 0)[:MAX_SHAPES]
    regressor = _array(fields, "J_regressor", (joints, verts))
    weights = _array(fields, "weights", (verts, joints))
    if np.abs(regressor.sum(axis=1) - 1).max() > _SUM_TOLERANCE:
        joint = int(np.argmax(np.abs(regressor.sum(axis=1) - 1)))
        raise InputError(f"expected rows of J_regressor that sum to 1, found {regressor[joint].sum():.4g} in {joint}")
    if weights.min(initial=0) < -_SUM_TOLERANCE or np.abs(weights.sum(axis=1) - 1).max(initial=0) > _SUM_TOLERANCE:
        vertex = int(np.argmax(np.abs(weights.sum(axis=1) - 1) - weights.min(axis=1)))
        low, high, total = (
            float(each) for each in (weights[vertex].min(), weights[vertex].max(), weights[vertex].sum())
        )
        found = f"{low:.4g} to {high:.4g}, {total:.4g} in all, at vertex {vertex}"
        raise InputError(f"expected weights from 0 that sum to 1, found {found}")
    weights = np.maximum(weights, 0)
    return Body(
        template=Mesh(template.astype(np.float32), _faces(fields["f"], verts)),
        shape_directions=shapes.astype(np.float32),
        joints=(regressor @ template).astype(np.float32),
        joint_directions=np.einsum("jv,svc->sjc", regressor, shapes).astype(np.float32),
        joint_names=_joint_names(joints),
        parents=parents.astype(np.int32),
        skin_weights=(weights / weights.sum(axis=1, keepdims=True)).astype(np.float32),
        pose_directions=directions,
    )


def _array(fields: dict[str, np.ndarray], name: str, shape: tuple[int | None, ...]) -> np.ndarray:
    """Finite numbers of a shape, as float64; None is any length."""
    found = np.asarray(fields[name], np.float64)
    fits = found.ndim == len(shape) and all(side in (None, have) for side, have in zip(shape, found.shape, strict=True))
    if not fits or not found.size:
        wanted = ", ".join("any" if side is None else str(side) for side in shape)
        raise InputError(f"expected {name} of shape ({wanted}), found {found.shape}")
    if not np.isfinite(found).all():
        raise InputError(f"expected finite numbers in {name}, found NaN or infinity")
    return found


def _require_known(joints: int) -> None:
    if joints in _KNOWN_JOINTS:
        return
    relative = _RELATIVES.get(joints)
    known = f", those of {relative}" if relative else ""
    raise InputError(f"expected {_FAMILY}, found {joints} joints{known}")


def _pose_directions(posedirs: np.ndarray | None, verts: int, joints: int) -> np.ndarray | None:
    """(9(J - 1), V, 3) float32, of one column for each number of a joint's rotation matrix."""
    if posedirs is None:
        return None
    directions, columns = np.asarray(posedirs, np.float64), 9 * (joints - 1)
    if directions.shape == (columns, 3 * verts):  # as smplx holds them
        directions = directions.T
    if directions.size % (3 * verts):
        raise InputError(f"expected posedirs of {verts} vertices, found an array of shape {directions.shape}")
    directions = directions.reshape(verts, 3, -1)
    if directions.shape[2] != columns:
        found = directions.shape[2]
        star = found in (4 * (joints - 1) + 1, 4 * (joints - 1), 4 * joints)
        relative = ": STAR or SUPR, whose pose blendshapes are of quaternions" if star else ""
        raise InputError(f"expected {columns} posedirs for {joints} joints, found {found}{relative}")
    if not np.isfinite(directions).all():
        raise InputError("expected finite numbers in posedirs, found NaN or infinity")
    return np.moveaxis(directions, 2, 0).astype(np.float32)


def _parents(table: np.ndarray) -> np.ndarray:
    """(J,) int64, -1 for the root."""
    table = np.asarray(table)
    if table.ndim != 2 or len(table) != 2 or not table.shape[1]:
        raise InputError(f"expected kintree_table of shape (2, joints), found {table.shape}")
    parents = np.asarray(table[0], np.float64)
    parents[0] = -1
    joints = np.arange(len(parents))
    if not np.isin(parents[1:], joints).all() or (parents[1:] >= joints[1:]).any():
        raise InputError("expected parents before their children in kintree_table, found a joint that has none, "
                         "or one after it")  # fmt: skip
    return parents.astype(np.int64)


def _faces(faces: np.ndarray, verts: int) -> np.ndarray:
    found = np.asarray(faces, np.float64)
    if found.ndim != 2 or found.shape[1] != 3 or not (found % 1 == 0).all():
        raise InputError(f"expected f as triangles, found {faces.dtype} of shape {faces.shape}")
    if found.size and not (found.min() >= 0 and found.max() < verts):
        raise InputError(
            f"expected faces of {verts} vertices, found vertex {found.max():.0f} or {found.min():.0f} in f"
        )
    return found.astype(np.int32)


_FAMILY = "SMPL (24 joints), SMPL-H (52) or SMPL-X (55)"
_KNOWN_JOINTS = (24, 52, 55)
_RELATIVES = {
    5: "FLAME, a head", 16: "MANO, a hand", 33: "SMAL, an animal", 35: "SMAL, an animal", 75: "SUPR"
}  # fmt: skip
_SUM_TOLERANCE = 1e-2
"""Files are rounded, some to two digits."""


def _joint_names(count: int) -> tuple[str, ...]:
    """SMPL's, as far as the family shares them."""
    if count == len(SMPL_JOINTS):
        return tuple(SMPL_JOINTS)
    shared = SMPL_JOINTS[: min(SHARED_JOINTS, count)]
    return (*shared, *(f"joint_{joint:02d}" for joint in range(len(shared), count)))
