"""Offset images among the surfaces that `compare` sets side by side: what `wrinkles offsets` has learned of the take.

References: Jin et al., A pixel-based framework for data-driven clothing, SCA 2020, sections 5 and 6.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
import torch

from capture4d.app.compare.garment import MB, ModelledSurface
from capture4d.types import Body, PoseSequence, RegisteredSequence
from wrinkles.offset_images.canvas import OffsetSampler
from wrinkles.offset_images.frames import offset_frames
from wrinkles.offset_images.model_files import BASELINE, DECODER, DIRECT, PATCHES, LearnedOffsets, OffsetModel
from wrinkles.offset_images.training import predict

__all__ = ["megabytes", "offset_surfaces"]

_IN_WORDS = {
    DECODER: "offset images", PATCHES: "offset images, patches", DIRECT: "fully connected",
    BASELINE: "fully connected, PCA",
}  # fmt: skip


def offset_surfaces(
    offsets: LearnedOffsets, sequence: RegisteredSequence, body: Body, poses: PoseSequence, rows: Sequence[int]
) -> list[ModelledSurface]:
    """What decoder, patches and baselines make of some frames' poses.

    Args:
        sequence, body, poses: the take they were learned from, and what moved it.
        rows: frames of the sequence that are wanted.
    Raises:
        InputError: a frame has no pose.
    """
    wanted = list(rows)
    moved = poses.of_frames(sequence.frame_ids[wanted])
    vertices = np.array(sequence.vertices[wanted])
    surfaces = []
    for name, model in offsets.models.items():
        made, ms = _predicted(model, body, moved, vertices)
        surfaces.append(ModelledSurface(_IN_WORDS[name], made, ms, megabytes(model.network)))
    return surfaces


def megabytes(network: torch.nn.Module) -> float:
    """Of its weights."""
    return sum(each.numel() * each.element_size() for each in network.state_dict().values()) / MB


def _predicted(model: OffsetModel, body: Body, poses: PoseSequence, vertices: np.ndarray) -> tuple[np.ndarray, float]:
    """Vertices (T, V, 3), metres, and the median time of a frame alone, ms."""
    frames = offset_frames(model.layout, body, poses, vertices, model.joints)
    sampler = OffsetSampler(model.layout)
    made, times = [], []
    for row in range(len(frames)):
        begin = time.perf_counter()
        made.append(predict(model.network, sampler, frames.rows([row]))[0].numpy() / 100)
        times.append(1e3 * (time.perf_counter() - begin))
    return np.stack(made), float(np.median(times))
