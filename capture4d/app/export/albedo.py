"""The colours of the cloth beside an export: a picture over the very UVs that are exported."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from capture4d.body.sewing_pattern import picture_uv
from capture4d.captures.work_folder import WorkFolder
from capture4d.errors import InputError
from capture4d.files.atomic import file_digest, write_bytes
from capture4d.files.pictures import picture_pixels, read_picture
from capture4d.files.records import load_garment
from capture4d.geometry.uv_raster import rasterise_uv
from capture4d.runs.stage import read_record
from capture4d.texturing.blending import spread_out
from capture4d.texturing.config import ALBEDO, TEMPLATE, TEXTURE
from capture4d.types import Garment, Mesh

__all__ = ["Albedo", "find_albedo", "write_albedo"]

_SAME = 1e-5
"""UVs that differ by less are the same."""
NONE = "none"


@dataclass(frozen=True, slots=True, eq=False)
class Albedo:
    """A picture of the cloth."""

    path: Path
    digest: str
    garment: Garment
    """Over whose UVs it lies, as `picture_span` says: that of the template beside it, if there is one."""


def find_albedo(work: WorkFolder, garment: Garment, given: str | None, notes: list[str]) -> Albedo | None:
    """The picture that was given, or else the one of `capture4d texture`, if it is of this registration.

    Args:
        given: path of a picture, or "none".
        notes: what is worth telling is added.
    Raises:
        InputError: there is no such picture, it is of another template, or the template has no UVs to lay it over.
    """
    if given == NONE:
        return None
    path = work.path / TEXTURE / ALBEDO if given is None else Path(given)
    if given is None:
        record = read_record(path.with_name("stage.json")) if path.with_name("stage.json").is_file() else {}
        if record.get("status") != "complete" or not path.is_file():
            return None
        if record.get("upstream", {}).get("registration") != work.registered_digest:
            notes.append("the texture is left out: it is of an earlier registration; run 'texture' again")
            return None
    elif not path.is_file():
        raise InputError("no such picture of the cloth's colours", where=path)
    if garment.template.uv is None:
        raise InputError("expected a template with UVs under the picture of its colours, found none", where=work.path)
    beside = path.with_name(TEMPLATE)
    own = load_garment(beside) if beside.is_file() else garment
    if not np.array_equal(own.template.faces, garment.template.faces):
        raise InputError(f"expected a picture over the UVs of {work.path}, found one of another template", where=path)
    return Albedo(path, file_digest([path], root=path.parent), own)


def write_albedo(path: Path, albedo: Albedo, mesh: Mesh) -> None:
    """Write the picture as it lies over the UVs of a mesh, sRGB, 8 bits, and read it back.

    Args:
        mesh: of the same faces, its UVs in the unit square.
    Raises:
        InputError: the picture is damaged.
    """
    pixels, own = read_picture(albedo.path), picture_uv(albedo.garment)
    assert mesh.uv is not None
    if np.abs(own - mesh.uv).max() > _SAME:
        size = max(pixels.shape[:2])
        raster = rasterise_uv(mesh, size, padding=max(2, size // 256))
        places = raster.at_corners(own.astype(np.float64)).astype(np.float32)
        columns, rows = places[:, 0] * pixels.shape[1] - 0.5, (1 - places[:, 1]) * pixels.shape[0] - 0.5
        found = np.empty((len(places), 3), np.uint8)
        for start in range(0, len(places), _AT_ONCE):  # OpenCV takes no more rows of a map
            block = slice(start, start + _AT_ONCE)
            found[block] = cv2.remap(
                pixels, columns[block, None], rows[block, None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )[:, 0]
        known = raster.image(np.ones(len(found), bool))
        pixels = spread_out(raster.image(found), known)
    write_bytes(path, cv2.imencode(".png", pixels[..., ::-1])[1].tobytes())
    if not np.array_equal(picture_pixels(path.read_bytes()), pixels):
        raise InputError("read back: expected the picture that was written, found another", where=path)


_AT_ONCE = 30_000
