"""The pairs of a work folder as a value, and telling layouts apart."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool
from torch.nn import functional

from capture4d.errors import InputError
from capture4d.files.reading import reading
from capture4d.files.records import load_garment
from capture4d.geometry.uv_raster import rasterise_uv
from capture4d.runs.stage import complete_record
from capture4d.types import Mesh
from wrinkles.normal_maps.config import MapConfig
from wrinkles.normal_maps.pairs import PairTake
from wrinkles.normal_maps.spaces import decode_png

__all__ = ["MAPS", "PAIRS", "PairFolder", "layout_digest", "open_pairs", "read_map", "surface_texels"]

PAIRS = Path("wrinkles", "pairs")
"""Where they lie in a work folder."""
MAPS = "wrinkles maps"
"""The stage that makes them."""


def layout_digest(mesh: Mesh, size: int) -> str:
    """What two templates must share for one network to serve both."""
    assert mesh.uv is not None
    rounded = np.round(mesh.uv * 65536).astype(np.int32)
    return hashlib.sha256(mesh.faces.tobytes() + rounded.tobytes() + str(size).encode()).hexdigest()[:16]


def surface_texels(mesh: Mesh, size: int, texels: int) -> Bool[torch.Tensor, "1 texels texels"]:
    """Texels that show the surface itself, not the padding that repeats its border.

    Args:
        size, texels: sides of the maps on disk, and of those that are wanted.
    """
    raster = rasterise_uv(mesh, size, padding=0)
    inside = torch.from_numpy(raster.image(raster.inside)).float()[None]
    return functional.avg_pool2d(inside, size // texels) >= 0.5


@dataclass(frozen=True, slots=True, eq=False)
class PairFolder:
    """The finished pairs of a work folder, opened once; the maps stay on disk until they are read."""

    work: Path
    digest: str
    registration: str
    """Digest of the registration they were made from."""
    maps: MapConfig
    """How they lie in their images."""
    template: Mesh
    """Its UVs as the maps have them, its vertices as garment coordinates refer to them."""

    @property
    def path(self) -> Path:
        return self.work / PAIRS

    @property
    def layout_digest(self) -> str:
        """What a network for these maps must have been trained on."""
        return layout_digest(self.template, self.maps.size)

    def read(self) -> PairTake:
        """All pairs.

        Raises:
            InputError: there are none, or they are damaged or of different sizes.
        """
        paths = sorted(path for path in (self.path / "high").glob("*.png") if path.stem.isdigit())
        low, high, valid = [], [], []
        for path in paths:
            lower, shown = read_map(self.path / "low" / path.name)
            higher, known = read_map(path)
            if higher.shape != lower.shape or lower.shape != (low[0].shape if low else lower.shape):
                expected = " x ".join(str(side) for side in (low[0] if low else lower).shape[:2])
                found = " x ".join(str(side) for side in higher.shape[:2])
                raise InputError(f"expected a map and a mask of {expected} texels, found {found}", where=path)
            low.append((lower * shown[..., None]).astype(np.float16))
            high.append((higher * known[..., None]).astype(np.float16))
            valid.append(known)
        if not paths:
            raise InputError("expected maps, found none", where=self.path / "high")
        frame_ids = np.array([int(path.stem) for path in paths], np.int32)

        def stacked(images: list[np.ndarray]) -> torch.Tensor:
            return torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2).contiguous()

        masks = stacked([each[..., None] for each in valid])
        return PairTake(self.work.resolve().name, frame_ids, stacked(low), stacked(high), masks)


def open_pairs(work: Path) -> PairFolder:
    """Open the pairs of a work folder.

    Raises:
        InputError: they are missing or unfinished.
    """
    folder = work / PAIRS
    record = complete_record(folder, MAPS, f"capture4d wrinkles maps {work}")
    with reading(folder / "stage.json", "record of normal maps"):
        registration, maps = record["upstream"]["registration"], MapConfig(**record["config"]["map"])
    return PairFolder(work, record["digest"], registration, maps, load_garment(folder / "template.npz").template)


def read_map(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """A 16-bit map and its mask.

    Raises:
        InputError: the file is missing or damaged.
    """
    with reading(path, "normal map"):
        return decode_png(path.read_bytes(), source=str(path))
