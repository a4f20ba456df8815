"""Settings of the wrinkles, split by role. Standard library only: the command line imports this to print its help."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, replace
from typing import Annotated, Literal

from capture4d.settings import Count, Degrees, NonNegative, Odd, Part, Positive, Seed, Share, Whole, settings

__all__ = [
    "PRESETS",
    "ApplyConfig",
    "AugmentationConfig",
    "LossConfig",
    "MapConfig",
    "NetworkConfig",
    "PairConfig",
    "ProjectionConfig",
    "ScheduleConfig",
    "WrinkleConfig",
]

TemporalLoss = Literal["printed", "l1", "l2", "none"]


@settings
class MapConfig:
    """The image in which normals lie."""

    size: Count = 256
    """Texels along each side."""
    padding: Whole = 4
    """Texels around the UV islands that repeat the nearest surface point."""
    layout: Literal["auto", "keep", "pack"] = "auto"
    """UVs in the unit square are kept, patterns in metres packed into it (auto); or one of the two always."""

    @property
    def smallest(self) -> int:
        """Texels at which islands that were laid out with this padding still have a texel of it."""
        return -(-self.size // max(self.padding, 1))

    def sized(self, size: int) -> MapConfig:
        """The same layout at another number of texels, as much of it padding."""
        return replace(self, size=size, padding=self.padding * size // self.size)


@settings
class ProjectionConfig:
    """How a scan is read from the template. On simulated scans, gates of 10-15 mm and 60 deg left a fifth of the
    wrinkle energy that gates of 4-6 mm and 45 deg leave."""

    distance_m: NonNegative = 0.006
    """A scan farther than this from the template says nothing."""
    angle_deg: Degrees = 45.0
    """Nor does one that faces another way by more than this."""
    border_rings: Whole = 1
    """Rings of scan vertices along open borders that are not trusted: 1 is the border itself, 0 trusts all."""
    smoothing_passes: Whole = 1
    """Steps of half-way averaging of the scan's normals with their neighbours'."""
    temporal_frames: Annotated[Count, Odd] = 3
    """Frames averaged in tangent space, an odd number."""
    temporal_span_s: NonNegative = 0.02
    """Neighbours farther apart in time are left out: the cloth itself has moved."""
    blur_texels: NonNegative = 0.4
    """Standard deviation of the blur, texels of a map of 256."""


@settings
class PairConfig:
    """Pairs of low- and high-resolution normal maps."""

    map: MapConfig = field(default_factory=MapConfig)
    projection: ProjectionConfig = field(default_factory=ProjectionConfig)


@settings
class NetworkConfig:
    """Generator and discriminator (DeepWrinkles 4.1; Isola et al. 2017, appendix)."""

    filters: Count = 64
    """In the first convolution of both."""
    layers: Count = 8
    """Down and up convolutions each; the map is 2^layers texels wide, or a multiple."""
    output: Literal["absolute", "residual"] = "absolute"
    """What the generator's tanh is: the normals, or what to add to those of the input."""
    dropout: Part = 0.5
    """In three inner layers of the decoder."""
    norm_at_test: Literal["instance", "running"] = "running"
    """Statistics of batch norm when maps are made: those of the map itself, as in pix2pix, or training's means."""


@settings
class LossConfig:
    """L = gan * L_GAN + data * L_data + temporal * L_temp (DeepWrinkles, Eq. 3-4)."""

    gan: NonNegative = 1.0
    """Weight of the adversarial loss."""
    data: NonNegative = 100.0
    """Weight of the difference from the high map."""
    temporal: NonNegative = 50.0
    """Weight of the temporal loss."""
    temporal_kind: TemporalLoss = "printed"
    """`printed` is Eq. 4, the net change of each channel; l1 and l2 compare texel by texel. The small presets take l2,
    with which maps are better and flicker less (`python -m benchmarks wrinkles`)."""


@settings
class AugmentationConfig:
    """Changes of the training pairs. Flips would break the UVs and are not among them."""

    turn_deg: NonNegative = 0.0
    """Standard deviation of a common rotation of low and high normals about the vertical."""
    noise: NonNegative = 0.0
    """Standard deviation of noise on the input normals."""


@settings
class ScheduleConfig:
    """How long to train, and what to keep."""

    steps: Count = 20_000
    """Of training."""
    batch: Count = 1
    """Frames in a step."""
    learning_rate: Positive = 2e-4
    """Of Adam."""
    beta1: Part = 0.5
    """Of Adam, decay of its first moment."""
    decay_from: Share = 0.5
    """Share of the steps after which the learning rate falls linearly to zero."""
    checkpoint_every: Count = 500
    """Steps between checkpoints."""
    checkpoint_s: NonNegative = 60.0
    """Seconds after which there is one in any case; they change nothing in the result."""
    sample_every: Count = 500
    """Steps between sheets of sample maps."""
    log_every: Count = 20
    """Steps between lines of metrics.jsonl."""
    half_precision: bool = False
    """Compute in bfloat16 where torch thinks it safe and the processor has it; it pays from 32 filters up."""


@settings
class WrinkleConfig:
    """Learning high-resolution normal maps from low ones."""

    seed: Seed = 0
    """Of the first weights and of the order of the frames."""
    held_out: Part = 0.1
    """Share at the end of every take that is left out of training, to be drawn and measured."""
    held_out_gap: Whole = 10
    """Frames between the two that belong to neither; neighbours are too alike."""
    texels: Count = 256
    """Side of the maps to learn; pairs are halved until they fit."""
    crop: Count | None = None
    """Side of the squares of them that a step learns from, wherever they lie; whole maps if absent. Maps are then made
    from squares that overlap."""
    network: NetworkConfig = field(default_factory=NetworkConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    augmentation: AugmentationConfig = field(default_factory=AugmentationConfig)
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)


_SMALL = WrinkleConfig(
    texels=128,
    network=NetworkConfig(filters=32, layers=7, output="residual", dropout=0.0),
    loss=LossConfig(temporal_kind="l2"),
    schedule=ScheduleConfig(steps=4000, batch=4, learning_rate=4e-4, half_precision=True),
)


@settings
class ApplyConfig:
    """The form of the maps."""

    texels: Count | None = None
    """Along each side; those of the maps that the network's were made of if absent."""
    flip_green: bool = False
    """Y downwards, as DirectX and Unreal want it, instead of OpenGL's."""
    bits: Literal[8, 16] = 16
    """Per channel of the PNG files."""


PRESETS: Mapping[str, WrinkleConfig] = {
    "small": _SMALL,
    "small-256": replace(
        _SMALL,
        texels=256,
        network=replace(_SMALL.network, filters=16, layers=8),
        schedule=replace(_SMALL.schedule, steps=12_000, batch=2, half_precision=False),
    ),
    "small-512": replace(_SMALL, texels=512, crop=128),
    "paper": WrinkleConfig(),
}
"""`paper` is DeepWrinkles as printed, with pix2pix's defaults where it is silent; the others learn on a CPU."""
