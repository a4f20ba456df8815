"""A frame's offsets as pictures, edited by operations or in another program, and back as a mesh.

A drawn folder holds

front.tif, back.tif (or .exr, .png)  offsets, centimetres
offsets.npz                    what was drawn, and what was written: later only differences count
layout.json                    frame, take, texels, unit, range, space; operations that were applied
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from capture4d.body.binding import with_body_shape
from capture4d.body.limbs import WornBody
from capture4d.body.skinning import PosedBody, pose_frame, with_shape
from capture4d.captures.animations.config import RemovalConfig
from capture4d.captures.work_folder import WorkFolder
from capture4d.errors import InputError
from capture4d.files.arrays import ArrayFile
from capture4d.files.atomic import read_json, write_json, write_npz
from capture4d.files.json_values import entry, text, whole
from capture4d.files.reading import reading
from capture4d.geometry.intersection_removal import IntersectionRemoval, Removed
from capture4d.geometry.mesh import edge_lengths, unique_edges
from capture4d.types import Mesh
from wrinkles.offset_images.editing.changes import changed_vertices
from wrinkles.offset_images.editing.config import DrawConfig, PictureFormat
from wrinkles.offset_images.editing.operations import apply_operation, read_operations
from wrinkles.offset_images.editing.picture_files import RANGE_CM, read_change, write_picture
from wrinkles.offset_images.layout import OffsetLayout, encode

__all__ = ["Edited", "apply", "draw", "edit"]

SIDES = ("front", "back")
LAYOUT, OFFSETS = "layout.json", "offsets.npz"


@dataclass(frozen=True, slots=True, eq=False)
class Edited:
    """A frame's garment after its pictures were changed."""

    mesh: Mesh
    moved_mm: float
    """By the change, mean over the vertices that it moved; 0 if it moved none."""
    moved_share: float
    """Of the vertices."""
    removed: Removed | None
    """How it was taken out of the body; None where nothing had changed."""


@dataclass(frozen=True, slots=True, eq=False)
class _Drawn:
    """A drawn folder."""

    notes: dict[str, Any]
    kind: PictureFormat
    offsets: Float32[np.ndarray, "P 3"]
    written: tuple[np.ndarray, np.ndarray]
    change: Float32[np.ndarray, "size size 6"]

    @property
    def images(self) -> Float32[np.ndarray, "size size 6"]:
        """What its pictures show now, centimetres."""
        shown = [
            each if each.dtype.kind == "f" else RANGE_CM * (each.astype(np.float32) / 65535 - 0.5)
            for each in self.written
        ]
        return np.concatenate(shown, axis=-1).astype(np.float32) + self.change


def draw(work: WorkFolder, frame_id: int, output: Path, config: DrawConfig) -> None:
    """Draw the offsets of a registered frame into an empty folder.

    Raises:
        InputError: there is no such frame, or the template is not bound to the body that moved it.
    """
    layout, body, vertices = _frame(work, frame_id, config.texels)
    offsets = (100 * encode(layout.anchors(body), vertices[layout.vertex])).astype(np.float32)
    images = layout.draw(offsets)
    written = [
        write_picture(output / f"{name}.{config.format}", images[..., 3 * side : 3 * side + 3], config.format)
        for side, name in enumerate(SIDES)
    ]
    write_npz(output / OFFSETS, offsets=offsets, front=written[0], back=written[1])
    notes = {
        "frame": frame_id,
        "registration": work.registered_digest,
        "texels": config.texels,
        "format": config.format,
        "space": "local",
        "channels": ["tangent", "bitangent", "normal"],
        "unit": "cm",
        "range_cm": None if config.format != "png" else [-RANGE_CM / 2, RANGE_CM / 2],
        "operations": [],
    }
    write_json(output / LAYOUT, notes)


def edit(drawn: Path, operations: Path, work: WorkFolder, output: Path) -> None:
    """The pictures of a folder after the operations of a file, in another folder; the first stays as it is.

    Raises:
        InputError: an operation is unknown, or a folder is damaged or of another take or size.
    """
    wanted = read_operations(operations)
    found = _read(drawn)
    layout, _, _ = _frame(work, whole(found.notes["frame"], "frame"), whole(found.notes["texels"], "texels"))
    images = found.images
    for operation in wanted:
        other = None
        if operation.source:
            other = _read(operations.parent / operation.source).images
            if other.shape != images.shape:
                raise InputError(f"expected {len(images)} texels as in {drawn}, found {len(other)}",
                                 where=operations.parent / operation.source)  # fmt: skip
        images = apply_operation(images, operation, layout.mask, other)
    for side, name in enumerate(SIDES):
        write_picture(output / f"{name}.{found.kind}", images[..., 3 * side : 3 * side + 3], found.kind)
    shutil.copyfile(drawn / OFFSETS, output / OFFSETS)
    done = [*found.notes.get("operations", []), *read_json(operations)["operations"]]
    write_json(output / LAYOUT, found.notes | {"operations": done})


def apply(drawn: Path, work: WorkFolder, config: RemovalConfig) -> Edited:
    """The garment that the pictures of a folder show, out of the body.

    Raises:
        InputError: the folder is damaged, or of another registration.
    """
    found = _read(drawn)
    if found.notes["registration"] != work.registered_digest:
        raise InputError(f"expected pictures of the registration in {work.path}, found another's", where=drawn)
    frame_id, texels = whole(found.notes["frame"], "frame"), whole(found.notes["texels"], "texels")
    layout, body, vertices = _frame(work, frame_id, texels)
    if found.offsets.shape != (len(layout.vertex), 3):
        raise InputError(f"expected offsets of {len(layout.vertex)} pixels, found {len(found.offsets)}",
                         where=drawn / OFFSETS)  # fmt: skip
    changed = changed_vertices(layout, body, vertices, found.offsets, found.change)
    moved = np.linalg.norm(changed - vertices, axis=1)
    garment, removed = layout.garment, None
    if moved.any():
        edges, weights = unique_edges(garment.template.faces), garment.skin_weights
        assert weights is not None
        # what somebody has painted may be as long as it is
        removal = IntersectionRemoval(
            garment.template.faces, len(changed), edge_lengths(changed, edges), float("inf"), config
        )
        person = body.shaped
        at_rest = with_body_shape(garment, person.body, person.shape).template.vertices
        worn = WornBody(person, at_rest.astype(np.float64), weights)
        removed = removal(changed, worn.posed(body.vertices()))
        changed = removed.vertices
    mesh = garment.template.with_vertices(changed.astype(np.float32))
    mean = 1e3 * float(moved[moved > 0].mean()) if moved.any() else 0.0
    return Edited(mesh, mean, float((moved > 0).mean()), removed)


def _frame(work: WorkFolder, frame_id: int, texels: int) -> tuple[OffsetLayout, PosedBody, Float64[np.ndarray, "V 3"]]:
    """Layout, posed body and vertices of a registered frame."""
    sequence = work.registered
    rows = np.flatnonzero(sequence.frame_ids == frame_id)
    if not len(rows):
        raise InputError(f"expected a registered frame, found none with number {frame_id}", where=work.path)
    body, poses = work.require_posed_body()
    garment, poses = sequence.garment, poses.of_frames(sequence.frame_ids[rows])
    weights = garment.skin_weights
    if weights is None or weights.shape[1] != len(body.joint_names):
        raise InputError("expected a template that is bound to the body that moved it, found another", where=work.path)
    posed = pose_frame(with_shape(body, poses.shape), poses, 0)
    return OffsetLayout.create(garment, texels), posed, np.array(sequence.vertices[rows[0]], np.float64)


def _read(folder: Path) -> _Drawn:
    notes = read_json(folder / LAYOUT)
    with reading(folder / LAYOUT, "layout"):
        texels = whole(entry(notes, "texels"), "texels", least=16, most=2**14)
        for name in ("frame", "registration"):
            entry(notes, name)
        kind = text(entry(notes, "format"), "format")
        known: dict[str, PictureFormat] = {"tif": "tif", "exr": "exr", "png": "png"}
        if kind not in known:
            raise InputError(f"format: expected {', '.join(known)}, found {kind[:40]!r}")
    chosen = known[kind]
    with ArrayFile(folder / OFFSETS) as arrays:
        offsets, front, back = (arrays[name] for name in ("offsets", "front", "back"))
    wanted = np.dtype(np.float32) if chosen != "png" else np.dtype(np.uint16)
    whole_file = offsets.ndim == 2 and offsets.shape[1] == 3 and np.isfinite(offsets).all()
    if not whole_file or any(each.shape != (texels, texels, 3) or each.dtype != wanted for each in (front, back)):
        raise InputError(f"expected offsets and two pictures of {texels} texels, found others", where=folder / OFFSETS)
    change = [read_change(folder / f"{name}.{chosen}", each) for name, each in zip(SIDES, (front, back), strict=True)]
    return _Drawn(notes, chosen, offsets.astype(np.float32), (front, back), np.concatenate(change, axis=-1))
