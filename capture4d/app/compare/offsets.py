"""Offset images among the surfaces that `compare` sets side by side: decoder and baseline, learned from the take.

References: Jin et al., A pixel-based framework for data-driven clothing, SCA 2020, sections 5 and 6.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
import torch

from capture4d.app.compare.config import CompareConfig
from capture4d.app.compare.garment import MB, ModelledSurface
from capture4d.body.skinning import with_shape
from capture4d.errors import InputError
from capture4d.learning.networks import ImageDecoder
from capture4d.types import Body, PoseSequence, RegisteredSequence
from retarget.shapes.pose_normalisation import PoseRows
from wrinkles.offset_images.layout import OffsetLayout, OffsetSampler
from wrinkles.offset_images.networks import PcaFullyConnected
from wrinkles.offset_images.training import (
    OffsetConfig,
    OffsetFrames,
    offset_frames,
    pose_joints,
    predict,
    train_offsets,
)

__all__ = ["megabytes", "offset_surfaces"]

LARGEST_BATCH, BATCHES, SMALLEST_BATCH = 16, 8, 4
"""A short take is learned from in as many batches, unless they become too small for batch norm."""


def offset_surfaces(
    sequence: RegisteredSequence,
    body: Body,
    poses: PoseSequence,
    rows: Sequence[int],
    learned: Sequence[int],
    config: CompareConfig,
) -> list[ModelledSurface]:
    """Learn decoder and baseline on some frames, of which the last ninth stops them, and predict others.

    Args:
        sequence, body, poses: a registered take of a bound template, and what moved it.
        rows, learned: frames of the sequence to predict, and to learn from.
    Raises:
        InputError: there are not two frames to learn from.
    """
    if len(learned) < 2:
        raise InputError(f"compare: expected at least 2 soundly registered frames to learn from, found {len(learned)}")
    garment, size = sequence.garment, config.image_texels
    assert garment.skin_weights is not None
    ordered = PoseRows.match(sequence, with_shape(body, poses.shape), poses).poses
    joints = pose_joints(ordered, garment.skin_weights)
    layout = OffsetLayout.create(garment, size)
    frames = offset_frames(layout, body, ordered, np.array(sequence.vertices), joints)
    cut = len(learned) - max(len(learned) // 9, 1)
    parts = frames.rows(list(learned[:cut])), frames.rows(list(learned[cut:]))
    held, sampler = frames.rows(list(rows)), OffsetSampler(layout)
    torch.manual_seed(0)
    doublings = size.bit_length() - 4
    channels = max(size * 3 // 2, 2**doublings)
    networks = {
        "offset images": ImageDecoder(frames.pose.shape[1], channels=channels, doublings=doublings),
        "fully connected, PCA": PcaFullyConnected(frames.pose.shape[1], parts[0].offsets, components=128),
    }
    batch = min(LARGEST_BATCH, max(SMALLEST_BATCH, len(parts[0]) // BATCHES))
    surfaces = []
    for name, network in networks.items():
        train_offsets(network, layout, *parts, OffsetConfig(epochs=config.epochs, batch=batch))
        made, ms = _predicted(network, sampler, held)
        surfaces.append(ModelledSurface(name, made, ms, megabytes(network)))
    return surfaces


def megabytes(network: torch.nn.Module) -> float:
    """Of its weights."""
    return sum(each.numel() * each.element_size() for each in network.state_dict().values()) / MB


def _predicted(network: torch.nn.Module, sampler: OffsetSampler, frames: OffsetFrames) -> tuple[np.ndarray, float]:
    """Vertices (T, V, 3), metres, and the median time of a frame alone, ms."""
    made, times = [], []
    for row in range(len(frames)):
        begin = time.perf_counter()
        made.append(predict(network, sampler, frames.rows([row]))[0].numpy() / 100)
        times.append(1e3 * (time.perf_counter() - begin))
    return np.stack(made), float(np.median(times))
