"""What is exported, read from a work folder: the garment in chosen frames, its rate, its skeleton, its normal maps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from capture4d.app.export.albedo import Albedo, find_albedo
from capture4d.app.export.skeleton import Skeleton
from capture4d.body.sewing_pattern import picture_uv
from capture4d.body.skinning import with_shape
from capture4d.captures.work_folder import WorkFolder, load_registration
from capture4d.errors import InputError
from capture4d.files.arrays import map_array
from capture4d.files.records import load_garment
from capture4d.mesh_files.animated.moving_mesh import CLOTH_COLOUR, MovingMesh
from capture4d.runs.frame_lists import chosen_frames, frame_file, listed
from capture4d.runs.stage import read_record
from capture4d.types import Garment

__all__ = ["Clip", "MapFolder", "read_clip"]

_AT_ONCE = 64


@dataclass(frozen=True, slots=True, eq=False)
class MapFolder:
    """Normal maps of `wrinkles apply`."""

    path: Path
    digest: str
    bits: int
    flipped: bool
    """Whether green points down, as DirectX has it."""

    def file(self, frame_id: int) -> Path:
        return frame_file(self.path, frame_id, ".png")


@dataclass(frozen=True, slots=True, eq=False)
class Clip:
    """A garment that moves, and what goes with it."""

    moving: MovingMesh
    skeleton: Skeleton | None
    """None of a garment without a body."""
    maps: MapFolder | None
    albedo: Albedo | None
    """Of the cloth's colours."""
    notes: Sequence[str]
    """What is worth telling, a sentence each."""
    name: str = "garment"
    """Of its files."""
    colour: tuple[float, float, float] = CLOTH_COLOUR
    """Linear; seen where there is no picture of its colours."""


def read_clip(work: WorkFolder, frames: str = "", *, with_maps: bool = True, albedo: str | None = None) -> Clip:
    """
    Args:
        frames: those that are exported, as people write them; all if empty.
        with_maps: whether normal maps go along.
        albedo: a picture of the cloth's colours, "none", or None for that of WORK/texture.
    Raises:
        InputError: nothing is registered, nobody knows the frame rate, or there are no such frames.
    """
    notes: list[str] = []
    # Not the folder's own, which would keep in memory what was touched of it.
    folder = work.path / "registration"
    registered = load_registration(folder)
    garment, ids = registered.garment, registered.frame_ids
    del registered
    chosen = chosen_frames(frames, ids.tolist()) if frames else tuple(ids.tolist())
    rows = np.searchsorted(ids, np.array(chosen))
    failed = sorted(work.failed_frames & {*chosen})
    if failed:
        notes.append(
            f"{len(failed)} of {len(chosen)} frames have failed, and are exported as they are: {listed(failed)}"
        )
    maps, mesh = (_maps(work, notes) if with_maps else None), garment.template
    if maps is not None:
        missing = [frame_id for frame_id in chosen if not maps.file(frame_id).is_file()]
        if missing:
            notes.append(f"normal maps are left out: there is none of frame {missing[0]}")
            maps = None
        else:
            mesh = load_garment(maps.path / "template.npz").template  # its UVs are those of the maps
    coloured = find_albedo(work, garment, albedo, notes)
    if coloured is not None and maps is None:
        mesh = replace(mesh, uv=picture_uv(garment))
    moving = MovingMesh(
        mesh.with_vertices(next(_rows(folder / "vertices.npy", rows))),
        ids[rows],
        _frame_rate(work),
        partial(_rows, folder / "vertices.npy", rows),
    )
    return Clip(moving, _skeleton(work, garment, chosen), maps, coloured, notes)


def _rows(path: Path, rows: Int64[np.ndarray, " chosen"]) -> Iterator[np.ndarray]:
    """Rows of an array on disk, of which no more than a few stay in memory."""
    for start in range(0, len(rows), _AT_ONCE):
        mapped = map_array(path)
        for row in rows[start : start + _AT_ONCE]:
            yield np.array(mapped[row])


def _frame_rate(work: WorkFolder) -> float:
    recorded = work.stages["registration"].get("config") or {}
    if isinstance(recorded, dict) and isinstance(recorded.get("sequence_fps"), float):
        return recorded["sequence_fps"]
    if work.is_animated:
        posed = work.posed_body
        assert posed is not None
        return posed[1].fps
    return work.capture.fps


def _skeleton(work: WorkFolder, garment: Garment, frames: Sequence[int]) -> Skeleton | None:
    weights = garment.skin_weights
    posed = None if weights is None else work.posed_body
    if weights is None or posed is None:
        return None
    body, poses = posed
    if weights.shape[1] != len(body.joint_names):
        raise InputError(f"expected skin weights for {len(body.joint_names)} joints, found {weights.shape[1]}")
    return Skeleton.create(with_shape(body, poses.shape), poses.of_frames(np.array(frames, np.int32)), weights)


def _maps(work: WorkFolder, notes: list[str]) -> MapFolder | None:
    folder = work.path / "wrinkles" / "generated"
    if not (folder / "stage.json").is_file():
        return None
    record = read_record(folder / "stage.json")
    if record.get("status") != "complete":
        notes.append("normal maps are left out: they are not finished; run 'wrinkles apply' again")
        return None
    if record.get("upstream", {}).get("registration") != work.registered_digest:
        notes.append("normal maps are left out: they are of an earlier registration; run 'wrinkles apply' again")
        return None
    config = record["config"]
    return MapFolder(folder, record["digest"], int(config["bits"]), bool(config["flip_green"]))
