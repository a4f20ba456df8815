"""A trained network of offsets as a file, and the folder of those that were learned from a take."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Int

from capture4d.errors import InputError
from capture4d.files.atomic import read_json
from capture4d.files.json_values import entry, number, whole, wholes
from capture4d.files.reading import reading, shortened
from capture4d.files.tensors import read_tensors, write_tensors
from capture4d.learning.checkpoints import filled
from capture4d.learning.networks import ImageDecoder
from capture4d.runs.stage import complete_record
from wrinkles.offset_images.networks import PcaFullyConnected, image_decoder

__all__ = [
    "BASELINE",
    "DECODER",
    "FRAMES",
    "NETWORKS",
    "OFFSETS",
    "STAGE",
    "LearnedOffsets",
    "OffsetModel",
    "find_offsets",
    "load_offset_model",
    "save_offset_model",
]

STAGE, OFFSETS = "wrinkles offsets", Path("wrinkles", "offsets")
"""The stage that learns them, and where they lie in a work folder."""
FRAMES = "frames.json"
DECODER, BASELINE = "decoder", "fully_connected_pca"
NETWORKS = (DECODER, BASELINE)
KIND = "a network of offset images"


@dataclass(frozen=True, slots=True, eq=False)
class OffsetModel:
    """A network from the poses of some joints to a garment's offsets from the body."""

    network: ImageDecoder | PcaFullyConnected
    joints: Int[np.ndarray, " joints"]
    """Whose rotations it sees, in this order."""
    texels: int
    """Side of the images."""
    history: Sequence[Mapping[str, Any]]
    """Loss and validation error of every epoch."""


def save_offset_model(path: Path, model: OffsetModel) -> None:
    """Write the weights and what is needed to rebuild the network."""
    decodes = isinstance(model.network, ImageDecoder)
    about = {
        "network": DECODER if decodes else BASELINE,
        "joints": model.joints.tolist(),
        "texels": model.texels,
        "history": list(model.history),
    }
    weights = {name: each.numpy(force=True) for name, each in model.network.state_dict().items()}
    write_tensors(path, KIND, weights, about)


def load_offset_model(path: Path) -> OffsetModel:
    """Read a trained network.

    Raises:
        InputError: the file is missing, damaged or something else, or its weights are not those of its network.
    """
    file = read_tensors(path, KIND)
    with reading(path, "network"):
        kind, history = file.entry("network"), file.entry("history")
        joints = np.array(wholes(file.entry("joints"), "joints"), np.int64)
        if not len(joints):
            raise InputError("joints: expected at least one, found none")
        texels = whole(file.entry("texels"), "texels", least=8)
        if kind not in NETWORKS:
            raise InputError(f"expected a network called {' or '.join(NETWORKS)}, found {shortened(str(kind), 80)}")
        if not isinstance(history, list) or not all(isinstance(epoch, dict) for epoch in history):
            raise InputError("history: expected a list of epochs, found something else")
        make = partial(image_decoder, 9 * len(joints), texels)
        if kind == BASELINE:
            components, values = file["basis"].shape
            make = partial(PcaFullyConnected, 9 * len(joints), values // 3, components=components)
    network = filled(make, {name: torch.from_numpy(each) for name, each in file.tensors.items()}, source=path)
    if kind == DECODER:
        network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    return OffsetModel(network.eval(), joints, texels, history)


@dataclass(frozen=True, slots=True, eq=False)
class LearnedOffsets:
    """What `wrinkles offsets` has learned from a take."""

    digest: str
    held_out: float
    """Share of the take's end that it left out, and `gap`, the frames between."""
    gap: int
    seen: frozenset[int]
    """Frames that something was learned from, or that chose the epoch."""
    models: Mapping[str, OffsetModel]


def find_offsets(work: Path, *, registration: str) -> LearnedOffsets | None:
    """The networks in a work folder, None if nobody has asked for any.

    Args:
        registration: digest of the registration that they have to have been learned from.
    Raises:
        InputError: they are unfinished, damaged, or were learned from another registration.
    """
    folder = work / OFFSETS
    if not (folder / "stage.json").is_file():
        return None
    command = f"capture4d wrinkles offsets {work}"
    record = complete_record(folder, STAGE, command, made_from={"registration": registration})
    frames, config = read_json(folder / FRAMES), record.get("config")
    models = {name: load_offset_model(folder / f"{name}.safetensors") for name in NETWORKS}
    with reading(folder / FRAMES, "list of frames"):
        seen = frozenset(frame for name in ("learned", "chose_epoch") for frame in wholes(entry(frames, name), name))
    with reading(folder / "stage.json", "record of a stage"):
        held_out, gap = (
            number(entry(config, "held_out"), "held_out"),
            whole(entry(config, "held_out_gap"), "held_out_gap"),
        )
    return LearnedOffsets(record["digest"], held_out, gap, seen, models)
