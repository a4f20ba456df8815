"""Where computing in bfloat16 pays."""

from __future__ import annotations

import torch

__all__ = ["has_bfloat16"]


def has_bfloat16() -> bool:
    """Whether this processor has instructions for bfloat16. One with no more than AVX2 has to imitate it, and a
    convolution takes two to ten times as long as in full precision."""
    return bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())
