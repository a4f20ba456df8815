"""Reading the pairs of a work folder into memory, and telling layouts apart."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool
from torch.nn import functional

from capture4d.errors import InputError
from capture4d.files.atomic import read_json
from capture4d.files.reading import reading
from capture4d.files.records import load_garment
from capture4d.geometry.uv_raster import rasterise_uv
from capture4d.runs.stage import require_complete
from capture4d.types import Mesh
from wrinkles.normal_maps.config import MapConfig
from wrinkles.normal_maps.pairs import PairTake
from wrinkles.normal_maps.spaces import decode_png

__all__ = ["layout_digest", "load_pairs", "map_settings", "pair_template", "read_map", "surface_texels"]


def layout_digest(mesh: Mesh, size: int) -> str:
    """What two templates must share for one network to serve both."""
    assert mesh.uv is not None
    rounded = np.round(mesh.uv * 65536).astype(np.int32)
    return hashlib.sha256(mesh.faces.tobytes() + rounded.tobytes() + str(size).encode()).hexdigest()[:16]


def pair_template(work: Path) -> Mesh:
    """The template of a work folder's pairs: its UVs as the maps have them, its vertices as garment coordinates refer
    to them."""
    return load_garment(work / "wrinkles" / "pairs" / "template.npz").template


def map_settings(work: Path) -> MapConfig:
    """How a work folder's pairs lie in their images."""
    return MapConfig(**read_json(work / "wrinkles" / "pairs" / "stage.json")["config"]["map"])


def surface_texels(mesh: Mesh, size: int, texels: int) -> Bool[torch.Tensor, "1 texels texels"]:
    """Texels that show the surface itself, not the padding that repeats its border.

    Args:
        size, texels: sides of the maps on disk, and of those that are wanted.
    """
    raster = rasterise_uv(mesh, size, padding=0)
    inside = torch.from_numpy(raster.image(raster.inside)).float()[None]
    return functional.avg_pool2d(inside, size // texels) >= 0.5


def load_pairs(work: Path) -> PairTake:
    """All pairs of a work folder.

    Raises:
        InputError: they are missing, unfinished, or of different sizes.
    """
    folder = work / "wrinkles" / "pairs"
    require_complete(folder, "pairs", f"capture4d wrinkles maps {work}")
    paths = sorted(path for path in (folder / "high").glob("*.png") if path.stem.isdigit())
    low, high, valid = [], [], []
    for path in paths:
        lower, shown = read_map(folder / "low" / path.name)
        higher, known = read_map(path)
        if higher.shape != lower.shape or lower.shape != (low[0].shape if low else lower.shape):
            expected = " x ".join(str(side) for side in (low[0] if low else lower).shape[:2])
            raise InputError(f"expected a map and a mask of {expected} texels, found "
                             f"{' x '.join(str(side) for side in higher.shape[:2])}", where=path)  # fmt: skip
        low.append((lower * shown[..., None]).astype(np.float16))
        high.append((higher * known[..., None]).astype(np.float16))
        valid.append(known)
    if not paths:
        raise InputError("expected maps, found none", where=folder / "high")
    frame_ids = np.array([int(path.stem) for path in paths], np.int32)

    def stacked(images: list[np.ndarray]) -> torch.Tensor:
        return torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2).contiguous()

    return PairTake(work.name, frame_ids, stacked(low), stacked(high), stacked([each[..., None] for each in valid]))


def read_map(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """A 16-bit map and its mask.

    Raises:
        InputError: the file is missing or damaged.
    """
    with reading(path, "normal map"):
        return decode_png(path.read_bytes(), source=str(path))
