"""The commands about wrinkles: `capture4d wrinkles maps`, `train`, `apply`, `offsets`, and `compare`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from capture4d.app.compare.config import CompareConfig
from capture4d.cli.exit_codes import GOOD
from capture4d.cli.options import MeshOptions, StageOptions, all_cores
from capture4d.errors import CommandLineError
from capture4d.settings import Count
from wrinkles.normal_maps import config as wrinkle_config
from wrinkles.normal_maps.config import PairConfig, WrinkleConfig
from wrinkles.offset_images.config import OffsetConfig

__all__ = ["Compare", "WrinklesApply", "WrinklesMaps", "WrinklesOffsets", "WrinklesTrain"]


@dataclass(frozen=True, kw_only=True)
class WrinklesMaps(StageOptions, MeshOptions):
    """Make normal maps of a registered take: low ones from the template, high ones from its scans.

    The model's answers to a take pair with its high maps: `capture4d animate MODEL --poses TAKE/body/poses.npz --output
    WORK`, then `capture4d wrinkles maps WORK --high-from TAKE`.
    """

    work: Annotated[Positional[Path], arg(metavar="WORK")]
    """Work folder; holds garment/ and registration/, gets wrinkles/pairs/."""
    high_from: Path | None = None
    """Work folder of the same frames, with finished maps, whose high ones are taken."""
    texels: Count | None = None
    """Along each side of the maps: --pairs.map.size, and as much more padding."""
    config: Annotated[PairConfig, arg(name="pairs")] = field(default_factory=PairConfig)

    def __call__(self) -> int:
        from capture4d import pipeline

        maps, usual = self.config.map, wrinkle_config.MapConfig()
        if self.texels is not None and maps.size not in (usual.size, self.texels):
            raise CommandLineError(f"--texels: expected the {maps.size} of --pairs.map.size, or one of the two alone, "
                                   f"found {self.texels}")  # fmt: skip
        if self.texels is not None and maps.size == usual.size:
            maps = maps.sized(self.texels)
        result = pipeline.wrinkles_maps(
            self.work,
            replace(self.config, map=maps),
            high_from=self.high_from,
            workers=self.workers,
            overwrite=self.overwrite,
        )
        print(f"maps: {result.path}")
        return GOOD


@dataclass(frozen=True, kw_only=True)
class WrinklesTrain(StageOptions, MeshOptions):
    """Train the network that turns low maps into high ones, on registered takes; makes their maps if need be."""

    works: Annotated[Positional[tuple[Path, ...]], arg(metavar="WORK...")]
    """Work folders of one garment."""
    output: Path
    """Model folder to write."""
    preset: Literal[*wrinkle_config.PRESETS] = "small"
    """What the settings below start from; `paper` is DeepWrinkles' network."""
    config: Annotated[WrinkleConfig, arg(name="")] = field(default_factory=lambda: wrinkle_config.PRESETS["small"])
    pairs: PairConfig = field(default_factory=PairConfig)
    workers: Count = field(default_factory=all_cores)
    """Processes for the maps, threads for the training; equal numbers give equal weights."""

    def __call__(self) -> int:
        from capture4d import pipeline

        result = pipeline.wrinkles_train(
            self.works, self.output, self.config, pairs=self.pairs, workers=self.workers, overwrite=self.overwrite
        )
        print(f"model: {result.path}")
        return GOOD


@dataclass(frozen=True, kw_only=True)
class WrinklesApply(StageOptions, MeshOptions):
    """Make tangent-space normal maps with wrinkles for a registered or animated take."""

    model: Annotated[Positional[Path], arg(metavar="MODEL")]
    """Model folder of `wrinkles train`, or its generator.safetensors."""
    work: Annotated[Positional[Path], arg(metavar="WORK")]
    """Work folder; holds registration/, gets wrinkles/generated/."""
    texels: Count | None = None
    """Along each side of the maps, such as 1024; those of the maps that MODEL's were made of if absent."""
    flip_green: bool = False
    """Y downwards, as DirectX and Unreal want it, instead of OpenGL's."""
    bits: Literal[8, 16] = 16
    """Per channel of the PNG files."""

    def __call__(self) -> int:
        from capture4d import pipeline

        config = wrinkle_config.ApplyConfig(self.texels, flip_green=self.flip_green, bits=self.bits)
        result = pipeline.wrinkles_apply(self.model, self.work, config, workers=self.workers, overwrite=self.overwrite)
        print(f"maps: {result.path / 'frames'}")
        return GOOD


@dataclass(frozen=True, kw_only=True)
class WrinklesOffsets(StageOptions, MeshOptions):
    """Learn offset images of a registered take from its poses, and baselines without images; `compare` shows them."""

    work: Annotated[Positional[Path], arg(metavar="WORK")]
    """Work folder; holds registration/, gets wrinkles/offsets/."""
    config: Annotated[OffsetConfig, arg(name="")] = field(default_factory=OffsetConfig)
    workers: Count = field(default_factory=all_cores)
    """Threads for the training; equal numbers give equal weights."""

    def __call__(self) -> int:
        from capture4d import pipeline

        result = pipeline.wrinkles_offsets(self.work, self.config, workers=self.workers, overwrite=self.overwrite)
        print(f"offset images: {result.path}")
        return GOOD


@dataclass(frozen=True, kw_only=True)
class Compare(StageOptions, MeshOptions):
    """Compare registration, garment model, generated maps and offset images on the same held-out frames: one table, one
    page. Learns nothing itself: `fit`, `wrinkles train` and `wrinkles offsets` do."""

    work: Annotated[Positional[Path], arg(metavar="WORK")]
    """Work folder; holds garment/, registration/ and perhaps wrinkles/offsets/, gets compare/."""
    model: Path
    """Model folder of `wrinkles train`."""
    garment_model: Path | None = None
    """What `fit` wrote; WORK/retarget, if there is one, by default."""
    config: Annotated[CompareConfig, arg(name="")] = field(default_factory=CompareConfig)

    def __call__(self) -> int:
        from capture4d import pipeline

        compared = pipeline.compare(
            self.work,
            self.model,
            self.config,
            garment_model=self.garment_model,
            workers=self.workers,
            overwrite=self.overwrite,
        )
        print(f"comparison: {compared.path}")
        return GOOD
