"""A set of drapes, as `synth-drapes` writes it: one garment of one style on one person, at rest in many poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Int32

from capture4d.errors import InputError
from capture4d.files.arrays import ArrayFile
from capture4d.files.atomic import read_json
from capture4d.files.json_values import entry, number, text
from capture4d.files.reading import reading
from capture4d.files.records import load_body, load_garment
from capture4d.runs.stage import complete_record
from capture4d.types import Body, Garment
from capture4d.value_checks import require_array, require_finite, require_rotations

__all__ = ["DrapeSet", "read_drapes"]


@dataclass(frozen=True, slots=True, eq=False)
class DrapeSet:
    """Drapes, those that were pruned among them. A drape's pose follows from the seed and its number alone."""

    name: str
    """Of the kind of garment."""
    garment: Garment
    """As it was put on, unposed; bound to the body."""
    body: Body
    style: Mapping[str, float]
    """Numbers of the pattern, by name."""
    shape: Float32[np.ndarray, " shapes"]
    """Of the person, in standard deviations."""
    numbers: Int32[np.ndarray, " drapes"]
    """From 1, ascending."""
    rotations: Float32[np.ndarray, "drapes joints 3 3"]
    vertices: Float32[np.ndarray, "drapes verts 3"]
    """Metres, the root joint where the rest pose has it."""
    kept: Bool[np.ndarray, " drapes"]
    """False where a drape was pruned."""

    def __post_init__(self) -> None:
        count, joints = len(self.numbers), len(self.body.joint_names)
        require_array("DrapeSet", "numbers", self.numbers, (None,), np.int32)
        require_array("DrapeSet", "rotations", self.rotations, (count, joints, 3, 3), np.float32)
        require_array(
            "DrapeSet", "vertices", self.vertices, (count, len(self.garment.template.vertices), 3), np.float32
        )
        require_array("DrapeSet", "kept", self.kept, (count,), np.bool_)
        require_array("DrapeSet", "shape", self.shape, (None,), np.float32)
        require_rotations("DrapeSet", "rotations", self.rotations)
        for name in ("vertices", "shape"):
            require_finite("DrapeSet", name, getattr(self, name))
        if (np.diff(self.numbers) <= 0).any() or self.numbers[:1].sum() < 0:
            raise InputError("DrapeSet.numbers: expected ascending numbers, found others")
        if self.garment.skin_weights is None or self.garment.embedding_faces is None:
            raise InputError("DrapeSet.garment: expected one that is bound to the body, found one that is not")


def read_drapes(folder: Path) -> DrapeSet:
    """Read a finished set.

    Raises:
        InputError: the folder holds no set, an unfinished one, or a damaged one.
    """
    complete_record(folder, "synth-drapes", f"capture4d synth-drapes {folder}")
    about, path = read_json(folder / "drapes.json"), folder / "drapes.json"
    with reading(path, "description of drapes"):
        kind, values = text(entry(about, "garment"), "garment"), entry(about, "style")
        if not isinstance(values, dict) or not values:
            raise InputError("style: expected numbers by name, found none")
        style = {name: number(value, f"style.{name}") for name, value in values.items()}
        shape = np.array([number(value, "shape") for value in entry(about, "shape")], np.float32)
    shards = sorted((folder / "shards").glob("*.npz"))
    if not shards:
        raise InputError("expected shards of drapes, found none", where=folder / "shards")
    parts: dict[str, list[np.ndarray]] = {name: [] for name in ("drapes", "rotations", "vertices", "kept")}
    for shard in shards:
        with ArrayFile(shard) as arrays:
            for name, found in parts.items():
                found.append(arrays[name])
    garment, body = load_garment(folder / "garment.npz"), load_body(folder / "body.npz")
    with reading(shards[0], "shards of drapes"):
        joined = {name: np.concatenate(found) for name, found in parts.items()}
        return DrapeSet(
            kind, garment, body, style, shape,
            joined["drapes"], joined["rotations"], joined["vertices"], joined["kept"],
        )  # fmt: skip
