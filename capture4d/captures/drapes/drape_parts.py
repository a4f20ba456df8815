"""What is learned from a set of drapes and what is held back, and its mirror image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Int, Int64

from capture4d.captures.drapes.drape_sets import DrapeSet
from capture4d.errors import InputError
from capture4d.files.atomic import read_json
from capture4d.files.json_values import entry, wholes
from capture4d.files.reading import reading

__all__ = ["DrapeParts", "mirrored_drapes", "read_drape_parts"]

FLIP = np.array([-1.0, 1.0, 1.0])
OTHER_SIDE = {".L": ".R", ".R": ".L"}
"""Ends of the names of joints that the mirror exchanges."""


@dataclass(frozen=True, slots=True, eq=False)
class DrapeParts:
    """Rows of a set, and what else of it a network has to know."""

    train: Int64[np.ndarray, " train"]
    validation: Int64[np.ndarray, " validation"]
    test: Int64[np.ndarray, " test"]
    joints: Int64[np.ndarray, " joints"]
    """That the poses of the set move."""
    mirror: Int64[np.ndarray, " verts"]
    """The vertex on the other side of each."""


def read_drape_parts(folder: Path, drapes: DrapeSet) -> DrapeParts:
    """Read split and mirror of a set.

    Raises:
        InputError: they are missing, damaged, or not those of the drapes.
    """
    path = folder / "split.json"
    with reading(path, "split of drapes"):
        split = read_json(path)
        rows = {name: _rows(drapes, wholes(entry(split, name), name)) for name in ("train", "validation", "test")}
        if (np.bincount(np.concatenate([*rows.values()]), minlength=1) > 1).any():
            raise InputError("expected every drape in one part, found some in two")
    path = folder / "drapes.json"
    with reading(path, "description of drapes"):
        about = read_json(path)
        mirror = np.array(wholes(entry(about, "mirror"), "mirror"), np.int64)
        count = len(drapes.garment.template.vertices)
        if len(mirror) != count or (np.sort(mirror) != np.arange(count)).any():
            raise InputError(f"mirror: expected each of {count} vertices once, found something else")
        names, known = entry(about, "moved_joints"), drapes.body.joint_names
        if not isinstance(names, list) or not names or any(name not in known for name in names):
            raise InputError("moved_joints: expected names of the body's joints, found others")
        joints = np.array([known.index(name) for name in names], np.int64)
    return DrapeParts(rows["train"], rows["validation"], rows["test"], joints, mirror)


def _rows(drapes: DrapeSet, numbers: Sequence[int]) -> Int64[np.ndarray, " rows"]:
    wanted = np.array(numbers, np.int64)
    rows = np.searchsorted(drapes.numbers, wanted)
    if (rows >= len(drapes.numbers)).any() or (drapes.numbers[rows] != wanted).any():
        raise InputError(f"expected numbers of {len(drapes.numbers)} drapes, found others")
    return rows.astype(np.int64)


def mirrored_drapes(drapes: DrapeSet, mirror: Int[np.ndarray, " verts"]) -> DrapeSet:
    """The same drapes seen in a mirror: as good as drapes of the mirrored poses, for body and garment are the same on
    both sides."""
    names = drapes.body.joint_names
    other = [names.index(name[:-2] + OTHER_SIDE.get(name[-2:], name[-2:])) for name in names]
    turned = drapes.rotations[:, other] * np.outer(FLIP, FLIP)
    flipped = drapes.vertices[:, mirror] * FLIP
    return replace(drapes, rotations=turned.astype(np.float32), vertices=np.ascontiguousarray(flipped, np.float32))
