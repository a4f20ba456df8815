"""Rigs in other programs' files: what kind a file is, told by its content, and the way there and back."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from capture4d.cameras.colmap import read_model, write_model
from capture4d.cameras.colmap_files import find_model, model_suffix
from capture4d.cameras.metashape import read_metashape
from capture4d.cameras.nerfstudio import read_transforms
from capture4d.errors import InputError
from capture4d.files.atomic import read_json
from capture4d.files.outputs import new_files, new_files_in
from capture4d.files.reading import reading
from capture4d.files.records import load_rig, save_rig
from capture4d.types import Rig

__all__ = ["ForeignRig", "convert_rig", "read_foreign_rig"]

_TRANSFORMS = "transforms.json"
_OF_A_MODEL = (".bin", ".txt")


@dataclass(frozen=True, slots=True, eq=False)
class ForeignRig:
    """A rig that another program has written."""

    rig: Rig
    left_out: Sequence[str] = ()
    """Cameras of the file that are not in the rig, with the reason."""


def convert_rig(
    source: Path, output: Path, *, text: bool = False, scale: float = 1.0, overwrite: bool = False
) -> Sequence[str]:
    """A rig.json to a COLMAP model, or what another program wrote to a rig.json.

    Args:
        text: write the model as text.
        scale: metres in a unit of the source.
        overwrite: write over files that hold something else.
    Returns:
        Which cameras were left out, and why.
    Raises:
        InputError: neither, or damaged; or the output is what is read, or is there already and something else.
    """
    inputs = _files_of(source)
    if _is_rig(source):
        rig = _scaled(load_rig(source), scale)
        with new_files_in(output, inputs=inputs, overwrite=overwrite) as workshop:
            write_model(workshop, rig, text=text)
        return ()
    found = read_foreign_rig(source)
    with new_files([output], inputs=inputs, overwrite=overwrite) as workshop:
        save_rig(workshop / output.name, _scaled(found.rig, scale))
    return found.left_out


def _files_of(source: Path) -> list[Path]:
    """What is read of a source: a file, or the files of a model."""
    folder = source if source.is_dir() else source.parent
    if not folder.is_dir() or (folder != source and source.suffix.lower() not in _OF_A_MODEL):
        return [source]
    with contextlib.suppress(InputError):  # whoever reads it says what is wrong
        folder = find_model(folder)
    read = (path for path in folder.iterdir() if path.suffix.lower() in _OF_A_MODEL or path.name == _TRANSFORMS)
    return [source, *read]


def read_foreign_rig(source: Path) -> ForeignRig:
    """The cameras of a COLMAP model (a folder, or a file of it), a Metashape XML or a nerfstudio transforms.json.

    Raises:
        InputError: none of these, or damaged.
    """
    if source.is_dir():
        transforms = source / _TRANSFORMS
        made_for_nerf = model_suffix(source) is None and transforms.is_file()
        return ForeignRig(read_transforms(transforms) if made_for_nerf else read_model(source))
    if source.suffix.lower() in _OF_A_MODEL and source.stem in ("cameras", "images", "points3D", "frames", "rigs"):
        return ForeignRig(read_model(source.parent))
    if _begins_with(source) == "<":
        return ForeignRig(*read_metashape(source))
    return ForeignRig(read_transforms(source))


def _is_rig(source: Path) -> bool:
    """Whether a file is a rig.json, or nothing else either: then its reader says what is wrong with it."""
    if source.is_dir() or _begins_with(source) == "<" or source.suffix.lower() in _OF_A_MODEL:
        return False
    return "frames" not in read_json(source, expected="a JSON object with cameras, or with frames")


def _begins_with(source: Path) -> str:
    """The first letter of a text in any of XML's encodings."""
    with reading(source, "rig"), source.open("rb") as file:
        start = file.read(64)
    return start.replace(b"\0", b"").lstrip(b"\xef\xbb\xbf\xff\xfe \t\r\n")[:1].decode("latin-1")


def _scaled(rig: Rig, scale: float) -> Rig:
    if not 0 < scale < float("inf"):
        raise InputError(f"--scale: expected a positive number, found {scale:g}")
    moved = rig.T_camera_world.copy()
    moved[:, :3, 3] *= scale
    return replace(rig, T_camera_world=moved)
