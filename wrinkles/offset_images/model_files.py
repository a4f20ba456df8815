"""A trained network of offsets as a file, and the folder of those that were learned from a take."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Int, Int32

from capture4d.errors import InputError
from capture4d.files.atomic import read_json
from capture4d.files.json_values import entry, number, whole, wholes
from capture4d.files.reading import reading, shortened
from capture4d.files.tensors import TensorFile, read_tensors, write_tensors
from capture4d.learning.checkpoints import filled
from capture4d.learning.networks import ImageDecoder
from capture4d.runs.stage import complete_record
from capture4d.types import Garment
from capture4d.value_checks import require_array
from wrinkles.offset_images.canvas import OffsetSampler
from wrinkles.offset_images.config import PatchConfig
from wrinkles.offset_images.layout import OffsetLayout
from wrinkles.offset_images.networks import FullyConnected, PcaFullyConnected, image_decoder, patch_decoder
from wrinkles.offset_images.patches import OffsetFilter, Patchwork, cut_windows

__all__ = [
    "BASELINE",
    "DECODER",
    "DIRECT",
    "FRAMES",
    "NETWORKS",
    "OFFSETS",
    "PATCHES",
    "STAGE",
    "LearnedOffsets",
    "OffsetModel",
    "find_offsets",
    "load_offset_model",
    "save_offset_model",
    "small_patch_decoder",
]

STAGE, OFFSETS = "wrinkles offsets", Path("wrinkles", "offsets")
"""The stage that learns them, and where they lie in a work folder."""
FRAMES = "frames.json"
DECODER, PATCHES, DIRECT, BASELINE = "decoder", "patches", "fully_connected", "fully_connected_pca"
NETWORKS = (DECODER, PATCHES, DIRECT, BASELINE)
"""Patches are learned when they are asked for."""
KIND, LABELS = "a network of offset images", "labels"
SHUFFLED = 2
"""Doublings at the end of a patch's decoder that one convolution does by pixel shuffle, as `offsets train` has it."""


def small_patch_decoder(pose_size: int, patch: PatchConfig) -> ImageDecoder:
    """The decoder of a patch of a take, with random weights."""
    return patch_decoder(pose_size, patch.texels, channels=patch.channels, shuffled=SHUFFLED)


@dataclass(frozen=True, slots=True, eq=False)
class OffsetModel:
    """A network from the poses of some joints to a garment's offsets from the body."""

    network: ImageDecoder | Patchwork | FullyConnected | PcaFullyConnected
    joints: Int[np.ndarray, " joints"]
    """Whose rotations it sees, in this order."""
    layout: OffsetLayout
    history: Sequence[Mapping[str, Any]]
    """Loss and validation error of every epoch."""
    labels: Int32[np.ndarray, " F"] | None = None
    """Which patch a face belongs to, and `patch`, what the patches are like."""
    patch: PatchConfig | None = None


def save_offset_model(path: Path, model: OffsetModel) -> None:
    """Write the weights and what is needed to rebuild the network."""
    kinds = {ImageDecoder: DECODER, Patchwork: PATCHES, FullyConnected: DIRECT, PcaFullyConnected: BASELINE}
    about: dict[str, Any] = {
        "network": kinds[type(model.network)],
        "joints": model.joints.tolist(),
        "texels": model.layout.size,
        "history": list(model.history),
    }
    weights = {name: each.numpy(force=True) for name, each in model.network.state_dict().items()}
    if model.labels is not None and model.patch is not None:
        about["patch"] = asdict(model.patch)
        weights[LABELS] = model.labels
    write_tensors(path, KIND, weights, about)


def load_offset_model(path: Path, garment: Garment) -> OffsetModel:
    """Read a trained network.

    Args:
        garment: whose offsets it gives.
    Raises:
        InputError: the file is missing, damaged or something else, or its weights are not those of its network, or of
            another garment's.
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
        layout = OffsetLayout.create(garment, texels)
        labels, patch = None, None
        if kind == PATCHES:
            labels, about = file[LABELS], file.entry("patch")
            patch = PatchConfig(**{key: whole(entry(about, key), key) for key in PatchConfig.__dataclass_fields__})
        make = _maker(kind, layout, 9 * len(joints), file, labels, patch)
    weights = {name: torch.from_numpy(each) for name, each in file.tensors.items() if name != LABELS}
    network = filled(make, weights, source=path)
    if kind in (DECODER, PATCHES):
        network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    return OffsetModel(network.eval(), joints, layout, history, labels, patch)


def _maker(
    kind: str,
    layout: OffsetLayout,
    pose_size: int,
    file: TensorFile,
    labels: np.ndarray | None,
    patch: PatchConfig | None,
) -> Callable[[], ImageDecoder | Patchwork | FullyConnected | PcaFullyConnected]:
    """What makes a network of a file with random weights."""
    pixels = len(layout.vertex)
    if kind == DECODER:
        return partial(image_decoder, pose_size, layout.size)
    if kind == DIRECT:
        return partial(FullyConnected, pose_size, pixels)
    if labels is None or patch is None:
        return partial(PcaFullyConnected, pose_size, pixels, components=len(file["basis"]))
    require_array("network", LABELS, labels, (len(layout.faces),), np.int32)
    samplers = [OffsetSampler(layout, window) for window in cut_windows(layout, labels, patch.texels, patch.context)]
    kept = OffsetFilter(np.zeros(3 * pixels, np.float32), np.zeros((len(file["basis"]), 3 * pixels), np.float32))
    return lambda: Patchwork(layout, samplers, [small_patch_decoder(pose_size, patch) for _ in samplers], kept)


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


def find_offsets(work: Path, garment: Garment, *, registration: str) -> LearnedOffsets | None:
    """The networks in a work folder, None if nobody has asked for any.

    Args:
        garment: of the registration.
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
    with reading(folder / FRAMES, "list of frames"):
        seen = frozenset(frame for name in ("learned", "chose_epoch") for frame in wholes(entry(frames, name), name))
    with reading(folder / "stage.json", "record of a stage"):
        held_out, gap = (
            number(entry(config, "held_out"), "held_out"),
            whole(entry(config, "held_out_gap"), "held_out_gap"),
        )
        names = [name for name in NETWORKS if name != PATCHES or entry(config, "patched") is True]
    models = {name: load_offset_model(folder / f"{name}.safetensors", garment) for name in names}
    return LearnedOffsets(record["digest"], held_out, gap, seen, models)
