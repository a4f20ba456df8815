"""SMPL-family bodies from the user's own licensed files, turned into this project's plain arrays once.

SMPL, SMPL+H and SMPL-X are distributed to registered users as .npz or .pkl. A pickle can run code when it is loaded;
this reader runs none of it: it accepts the arrays, SciPy sparse matrices and chumpy wrappers those files hold, and
refuses every other name.
"""

from __future__ import annotations

import io
import pickle
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from capture4d.errors import InputError
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

_NUMPY_NAMES = {"_reconstruct", "ndarray", "dtype", "scalar"}


class _Shell:
    """Stands in for a chumpy or scipy object: keeps its state, runs nothing."""

    def __init__(self, *_: Any) -> None:
        self.state: dict[str, Any] = {}

    def __setstate__(self, state: Any) -> None:
        self.state = state if isinstance(state, dict) else {}


class _ArraysOnly(pickle.Unpickler):
    """An unpickler whose vocabulary is arrays: every global it may build is named here."""

    def find_class(self, module: str, name: str) -> Any:
        package = module.split(".")[0]
        if package == "numpy" and name in _NUMPY_NAMES:
            return super().find_class(module.replace("numpy.core", "numpy._core"), name)
        if package in ("chumpy", "scipy"):
            return _Shell
        if (module, name) == ("_codecs", "encode"):
            return super().find_class(module, name)
        raise InputError(f"expected only arrays in the pickle, found {module}.{name}")


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
    if not source.is_file():
        raise InputError(f"{source}: no such body file")
    try:
        fields = _read_fields(source)
    except InputError as error:
        raise InputError(f"{source}: {error}") from None
    except Exception as error:  # whatever a damaged file makes of the reader
        raise InputError(f"{source}: not an SMPL-family file, or damaged ({type(error).__name__})") from None
    needed = ("v_template", "shapedirs", "J_regressor", "weights", "kintree_table", "f")
    missing = [name for name in needed if name not in fields]
    if missing:
        raise InputError(f"{source}: expected an SMPL-family body, found no {', '.join(missing)}")
    return _assemble(fields)


def _read_fields(source: Path) -> dict[str, np.ndarray]:
    if source.suffix.lower() == ".npz":
        with np.load(source, allow_pickle=False) as archive:
            arrays = {name: _npz_array(archive, name) for name in archive.files}
        return {name: value for name, value in arrays.items() if value is not None}
    if source.suffix.lower() != ".pkl":
        raise InputError(f"expected an .npz or .pkl file, found '{source.suffix}'")
    loaded = _ArraysOnly(io.BytesIO(source.read_bytes()), encoding="latin1").load()
    if not isinstance(loaded, dict):
        raise InputError(f"expected a dictionary of arrays, found {type(loaded).__name__}")
    arrays = {str(name): _as_array(value) for name, value in loaded.items()}
    return {name: value for name, value in arrays.items() if value is not None}


def _npz_array(archive: Any, name: str) -> np.ndarray | None:
    """An array of numbers; None for anything else, which is not unpickled."""
    try:
        return _as_array(archive[name])
    except ValueError as error:
        if "allow_pickle" not in str(error):
            raise
        return None


def _as_array(value: Any) -> np.ndarray | None:
    if isinstance(value, np.ndarray):
        return value if value.dtype.kind in "fiu" else None
    if isinstance(value, _Shell):
        state = value.state
        if "indptr" in state:  # a SciPy compressed sparse matrix
            shape = state["_shape"] if "_shape" in state else state["shape"]
            kind = sparse.csr_matrix if len(state["indptr"]) == shape[0] + 1 else sparse.csc_matrix
            return kind((state["data"], state["indices"], state["indptr"]), shape=shape).toarray()
        return state.get("x")  # a chumpy array
    return None


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
