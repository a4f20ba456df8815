"""The pairs of a work folder as a value, and telling layouts apart."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO

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
from wrinkles.normal_maps.pairs import PairTake, fitted
from wrinkles.normal_maps.spaces import decode_png

__all__ = ["MAPS", "PAIRS", "PairFolder", "layout_digest", "open_pairs", "read_map", "surface_texels"]

PAIRS = Path("wrinkles", "pairs")
"""Where they lie in a work folder."""
MAPS = "wrinkles maps"
"""The stage that makes them."""
MAPPED_FROM = 1 << 30
"""Bytes of low maps, or of high ones, from which they are not kept in memory: 680 frames of 512 texels."""


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

    def read(self, texels: int | None = None) -> PairTake:
        """All pairs. If they take more than MAPPED_FROM, they lie in a scratch file beside them, not in memory.

        Args:
            texels: side to which they are halved; as they are if None.
        Raises:
            InputError: there are none, they are damaged or of different sizes, or cannot be halved to that side.
        """
        paths = sorted(path for path in (self.path / "high").glob("*.png") if path.stem.isdigit())
        if not paths:
            raise InputError("expected maps, found none", where=self.path / "high")
        frame_ids, name = np.array([int(path.stem) for path in paths], np.int32), self.work.resolve().name
        low, high, valid, first = _Frames(len(paths), self.path), _Frames(len(paths), self.path), [], ()
        for path in paths:
            one = self._read_one(name, path, first)
            first = first or one.low.shape[2:]
            one = one if texels is None else fitted(one, texels)
            low.add(one.low)
            high.add(one.high)
            valid.append(one.valid)
        return PairTake(name, frame_ids, low.whole(), high.whole(), torch.cat(valid))

    def _read_one(self, name: str, path: Path, expected: tuple[int, ...]) -> PairTake:
        """One frame, as large as the others."""
        lower, shown = read_map(self.path / "low" / path.name)
        higher, known = read_map(path)
        if higher.shape != lower.shape or lower.shape[:2] != (expected or lower.shape[:2]):
            wanted = " x ".join(map(str, expected or lower.shape[:2]))
            found = " x ".join(map(str, higher.shape[:2]))
            raise InputError(f"expected a map and a mask of {wanted} texels, found {found}", where=path)
        low, high = (
            torch.from_numpy((image * mask[..., None]).astype(np.float16)).permute(2, 0, 1)[None].contiguous()
            for image, mask in ((lower, shown), (higher, known))
        )
        return PairTake(name, np.array([int(path.stem)], np.int32), low, high, torch.from_numpy(known)[None, None])


class _Frames:
    """Maps one after another, in half precision: in memory, or in a file without a name if they are many."""

    def __init__(self, count: int, folder: Path) -> None:
        self._count, self._folder = count, folder
        self._kept: list[torch.Tensor] = []
        self._file: IO[bytes] | None = None

    def add(self, image: torch.Tensor) -> None:
        if self._file is None and not self._kept and self._count * image.numel() * 2 > MAPPED_FROM:
            self._file = TemporaryFile(dir=self._folder)  # noqa: SIM115 (`whole` closes it)
        if self._file is None:
            self._kept.append(image)
        else:
            self._kept = [image]
            self._file.write(image.numpy().tobytes())

    def whole(self) -> torch.Tensor:
        if self._file is None:
            return torch.cat(self._kept)
        shape = (self._count, *self._kept[0].shape[1:])
        with self._file as file:  # the mapping keeps it
            file.flush()
            return torch.from_numpy(np.memmap(file, np.float16, "r+", shape=shape))


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
