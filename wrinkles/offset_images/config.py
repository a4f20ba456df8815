"""Settings of offset images, split by role. Standard library only: the command line imports this to print its help."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, replace
from typing import Annotated, Literal

from capture4d.captures.animations.config import RemovalConfig
from capture4d.settings import (
    Condition,
    Count,
    NonNegative,
    Part,
    Positive,
    PowerOfTwo,
    Range,
    Seed,
    SettingError,
    Whole,
    settings,
)

__all__ = [
    "PRESETS",
    "DrapeOffsetsConfig",
    "OffsetConfig",
    "OffsetTrainingConfig",
    "PatchConfig",
    "PredictOffsetsConfig",
    "StripConfig",
]

Texels = Annotated[int, Range(least=16, most=1024), PowerOfTwo]
Eights = Condition(lambda number: number % 8 == 0, "a multiple of 8")


@settings
class OffsetTrainingConfig:
    """How the decoder and its baselines learn. Adam at 1e-3; the paper does not say the rest."""

    seed: Seed = 0
    """Of the first weights and of the order of the frames."""
    epochs: Count = 30
    """How often every frame is learned from."""
    batch: Annotated[int, Range(least=2)] = 16
    """Frames at most: a short take is learned from in eight batches, unless they would be too small for batch norm."""
    learning_rate: Positive = 1e-3
    """Falls to zero along a cosine."""
    norm: Literal["l1", "l2", "l2_squared"] = "l2"
    """Of the three channels of a texel, in the grid loss."""
    normal_weight: NonNegative = 5.0
    """Weight of the normals' loss, beside 1 of the offsets', which are centimetres. The paper's 0.01, of lengths in
    metres, is 1 here."""
    edge_weight: NonNegative = 0.0
    """Weight of the edge lengths' loss, which neckties need."""
    patience: Count = 12
    """Epochs without a better validation error after which training stops."""
    centred: bool = True
    """The decoder learns how images differ from their mean, and the baseline without PCA starts from the mean; the
    paper says nothing of either."""
    half_precision: bool = True
    """Compute the decoder in bfloat16 where torch thinks it safe and the processor has it; its losses are not."""
    checkpoint_every: Count = 5
    """Epochs."""


@settings
class PatchConfig:
    """Patches of a garment, each with a decoder of its own."""

    count: Annotated[int, Range(least=2)] = 28
    """Patches, where no labels say what they are: half of them in each image."""
    texels: Annotated[int, Range(least=16), Eights] = 80
    """Side of a patch's window. The paper has 160, of images of 512."""
    context: Whole = 8
    """Texels around a patch that the loss covers as well."""
    channels: Annotated[int, Range(least=16)] = 128
    """Of the first map; the paper has 512."""


@settings
class OffsetConfig:
    """Learning offsets from the body, as images, from the poses of a registered take."""

    held_out: Part = 0.1
    """Share at the end of the take that nothing is learned from, to be compared."""
    held_out_gap: Whole = 10
    """Frames between the two that belong to neither; neighbours are too alike."""
    texels: Texels = 256
    """Side of the images."""
    components: Count = 128
    """Principal components of the offsets that a baseline without images predicts; at most as many as there are."""
    patched: bool = False
    """Learn patches as well, each with a network of its own."""
    patch: PatchConfig = field(default_factory=PatchConfig)
    training: OffsetTrainingConfig = field(default_factory=OffsetTrainingConfig)


@settings
class StripConfig:
    """The image of a garment that is one strip, such as a necktie."""

    rows: Annotated[int, Range(least=16), Eights] = 64
    """Across the strip, texels."""
    columns: Annotated[int, Range(least=16), Eights] = 256
    """Along it."""
    channels: Annotated[int, Range(least=8)] = 64
    """Of the first map."""


@settings
class DrapeOffsetsConfig:
    """Learning a garment's offsets from the body from static drapes."""

    network: Literal["whole", "patches", "strip", "direct", "pca", "kernels"] = "whole"
    """What learns: a decoder of both images, of patches, of a strip; or, without images, fully connected layers, those
    to principal components, or kernels."""
    space: Literal["local", "body_local", "root_offset", "root_position"] = "local"
    """Axes of the offsets: tangent, bitangent and normal of the body under the cloth; the root's axes; or positions in
    those, which are no offsets."""
    texels: Texels = 256
    """Side of the images."""
    shuffled: Annotated[int, Range(least=0, most=3)] = 2
    """Doublings at the end that one convolution does by pixel shuffle; the paper has none, and takes nearly twice
    as long."""
    components: Count = 128
    """Principal components, at most, that `pca` gives."""
    mirrored: bool = True
    """Learn every drape once more as a mirror shows it."""
    residual: bool = False
    """Learn what is to be added to the kernels' guess, of which each drape is left out while it is learned from."""
    partner: bool = False
    """Answer with the mean of the network's and the kernels' offsets."""
    filter_components: Count = 2048
    """Principal components, at most, that stitched patches are projected on."""
    patch: PatchConfig = field(default_factory=PatchConfig)
    strip: StripConfig = field(default_factory=StripConfig)
    training: OffsetTrainingConfig = field(default_factory=lambda: OffsetTrainingConfig(half_precision=False))

    def __post_init__(self) -> None:
        if self.residual and self.partner:
            raise SettingError(self, "partner", "one of residual and partner", True)


@settings
class PredictOffsetsConfig:
    """Putting a garment that drapes have taught on a motion."""

    longest: NonNegative = 1.15
    """Edges are drawn together to this many times their length on the pattern; 0: they stay as long as they come."""
    unlike_deg: NonNegative = 10.0
    """A pose farther than this from every learned pose is reported, unless drapes that chose the epoch were farther."""
    fps: Positive | None = None
    """Frame rate of what is written; the motion's own if absent."""
    removal: RemovalConfig = field(default_factory=RemovalConfig)


_SMALL = DrapeOffsetsConfig()
_PAPER = replace(
    _SMALL, shuffled=0, mirrored=False,
    training=replace(_SMALL.training, epochs=24, normal_weight=1.0, centred=False),
)  # fmt: skip
_BASELINE = replace(_SMALL.training, epochs=100, patience=100)
PRESETS: Mapping[str, DrapeOffsetsConfig] = {
    "default": _SMALL,
    "patches": replace(_SMALL, network="patches"),
    "necktie": replace(
        _SMALL, network="strip", space="root_offset",
        training=replace(_SMALL.training, epochs=40, norm="l1", normal_weight=0.1, edge_weight=0.1),
    ),
    "direct": replace(_SMALL, network="direct", training=_BASELINE),
    "direct-with-kernels": replace(_SMALL, network="direct", partner=True, training=_BASELINE),
    "pca": replace(_SMALL, network="pca", training=_BASELINE),
    "kernels": replace(_SMALL, network="kernels"),
    "paper": _PAPER,
    "paper-patches": replace(
        _PAPER, network="patches", texels=512, patch=PatchConfig(texels=160, context=16, channels=512)
    ),
    "paper-necktie": replace(
        _PAPER, network="strip", space="root_offset",
        training=replace(_PAPER.training, norm="l1", normal_weight=0.1, edge_weight=0.1),
    ),
}  # fmt: skip
"""`paper` and what begins so is the networks and losses of Jin et al.; the others learn on a few cores.
With 287 drapes `direct-with-kernels` did best on those that choose the epoch (docs/notebook/offset-images.md)."""
