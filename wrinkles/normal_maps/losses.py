"""Losses of the wrinkle GAN on maps whose mask says which texels are known; everything is a mean over those.

Eq. 4 prints sums. A mean L1 beside a summed temporal term would weigh the latter by the number of texels, so one
reduction serves both.

References: DeepWrinkles (ECCV 2018), Eq. 3-4; Isola et al. 2017, Eq. 1.
"""

from __future__ import annotations

from typing import assert_never

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from wrinkles.normal_maps.config import TemporalLoss

__all__ = ["data_loss", "gan_loss", "temporal_loss"]

Images = Float[Tensor, "batch channels height width"]
Masks = Bool[Tensor, "batch 1 height width"]


def data_loss(generated: Images, truth: Images, valid: Masks) -> Float[Tensor, ""]:
    """L_data = |I_gen - I_gt|_1."""
    return _masked_mean((generated - truth).abs(), valid)


def temporal_loss(generated: Images, previous: Images, valid: Masks, kind: TemporalLoss) -> Float[Tensor, ""]:
    """What a map may differ from the true map of the frame before.

    Args:
        valid: texels known in both frames.
        kind: `printed` is Eq. 4, |sum_ij (I_gen,t - I_gt,t-1)|, for each channel: only the net change counts, so a
            wrinkle that moves costs nothing, and the gradient is the same in every texel. `l1` and `l2` compare texels.
    """
    difference = generated - previous
    match kind:
        case "none":
            return generated.new_zeros(())
        case "l1":
            return _masked_mean(difference.abs(), valid)
        case "l2":
            return _masked_mean(difference.square(), valid)
        case "printed":
            count = valid.sum(dim=(2, 3)).clamp(min=1)
            return ((difference * valid).sum(dim=(2, 3)) / count).abs().mean()
        case _:
            assert_never(kind)


def gan_loss(logits: Float[Tensor, "batch 1 rows columns"], *, real: bool) -> Float[Tensor, ""]:
    """Cross entropy of patches that shall be taken for real, or for made."""
    return functional.binary_cross_entropy_with_logits(logits.float(), torch.full_like(logits, float(real)).float())


def _masked_mean(values: Images, valid: Masks) -> Tensor:
    return (values * valid).sum() / (valid.sum() * values.shape[1]).clamp(min=1)
