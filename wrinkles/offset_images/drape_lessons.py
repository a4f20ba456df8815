"""Frames to learn from sets of static drapes: encoded, mirrored, and parted as the set is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Int

from capture4d.captures.drapes.drape_parts import DrapeParts, mirrored_drapes, read_drape_parts
from capture4d.captures.drapes.drape_sets import DrapeSet, read_drapes
from capture4d.errors import InputError
from capture4d.types import PoseSequence
from wrinkles.offset_images.frames import OffsetFrames, joined_frames, offset_frames
from wrinkles.offset_images.layout import OffsetLayout, OffsetSpace

__all__ = ["DrapeLesson", "drape_frames", "drape_lesson", "read_parted_drapes", "still_poses"]

STILL_FPS = 60.0
"""Drapes have no rate; their poses are told as if they were frames of a take."""


@dataclass(frozen=True, slots=True, eq=False)
class DrapeLesson:
    """Frames of each part of a set."""

    layout: OffsetLayout
    train: OffsetFrames
    """With their mirror images, if those are wanted, after them."""
    validation: OffsetFrames
    test: OffsetFrames


def read_parted_drapes(folder: Path) -> tuple[DrapeSet, DrapeParts]:
    """A finished set and its parts.

    Raises:
        InputError: it is none, unfinished or damaged, or too small to be learned from.
    """
    drapes = read_drapes(folder)
    parts = read_drape_parts(folder, drapes)
    counts = {name: len(getattr(parts, name)) for name in ("train", "validation", "test")}
    for name, least in (("train", 4), ("validation", 1), ("test", 1)):
        if counts[name] < least:
            raise InputError(f"expected at least {least} drapes to {name} with, found {counts[name]}; "
                             "synth-drapes makes more with --samples", where=folder)  # fmt: skip
    return drapes, parts


def drape_lesson(
    drapes: DrapeSet, parts: DrapeParts, *, texels: int, space: OffsetSpace, mirrored: bool
) -> DrapeLesson:
    """Encode all drapes of all parts.

    Args:
        texels: side of the images.
        mirrored: learn every drape once more as the mirror shows it.
    """
    layout = OffsetLayout.create(drapes.garment, texels)
    train = drape_frames(layout, drapes, parts.train, parts.joints, space=space)
    if mirrored:
        image = mirrored_drapes(drapes, parts.mirror)
        train = joined_frames([train, drape_frames(layout, image, parts.train, parts.joints, space=space)])
    validation, test = (
        drape_frames(layout, drapes, rows, parts.joints, space=space) for rows in (parts.validation, parts.test)
    )
    return DrapeLesson(layout, train, validation, test)


def drape_frames(
    layout: OffsetLayout,
    drapes: DrapeSet,
    rows: Int[np.ndarray, " rows"],
    joints: Int[np.ndarray, " joints"],
    *,
    space: OffsetSpace,
) -> OffsetFrames:
    """Encode some drapes of a set."""
    poses = still_poses(drapes, rows)
    return offset_frames(layout, drapes.body, poses, drapes.vertices[rows], joints, space=space)


def still_poses(drapes: DrapeSet, rows: Int[np.ndarray, " rows"]) -> PoseSequence:
    """The poses of some drapes of a set."""
    return PoseSequence(
        drapes.rotations[rows], np.zeros((len(rows), 3), np.float32), drapes.shape, drapes.numbers[rows], STILL_FPS,
        drapes.body.joint_names,
    )  # fmt: skip
