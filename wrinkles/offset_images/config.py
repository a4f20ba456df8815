"""Settings of offset images, split by role. Standard library only: the command line imports this to print its help."""

from __future__ import annotations

from dataclasses import field
from typing import Annotated, Literal

from capture4d.settings import Count, NonNegative, Part, Positive, PowerOfTwo, Range, Seed, Whole, settings

__all__ = ["OffsetConfig", "OffsetTrainingConfig"]


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
    norm: Literal["l1", "l2"] = "l2"
    """Of the three channels of a texel, in the grid loss; l2 is not squared."""
    normal_weight: NonNegative = 0.01
    """Weight of the normals' loss, beside 1 of the offsets'."""
    patience: Count = 12
    """Epochs without a better validation error after which training stops."""
    centred: bool = True
    """The decoder learns how images differ from their mean, and the baseline without PCA starts from the mean; the
    paper says nothing of either."""
    half_precision: bool = True
    """Compute the decoder in bfloat16 where torch thinks it safe; its losses are not."""
    checkpoint_every: Count = 5
    """Epochs."""


@settings
class OffsetConfig:
    """Learning offsets from the body, as images, from the poses of a registered take."""

    held_out: Part = 0.1
    """Share at the end of the take that nothing is learned from, to be compared."""
    held_out_gap: Whole = 10
    """Frames between the two that belong to neither; neighbours are too alike."""
    texels: Annotated[int, Range(least=16), PowerOfTwo] = 256
    """Side of the images."""
    components: Count = 128
    """Principal components of the offsets that the baseline without images predicts; at most as many as there are."""
    training: OffsetTrainingConfig = field(default_factory=OffsetTrainingConfig)
