"""A garment as a function of pose, learned from static drapes as offsets from the body; and the folder it is kept in.

garment.npz body.npz      the garment and the body it is bound to
model.safetensors         settings, joints, labels of the patches, kernels and the filter of stitched patches
networks/01.safetensors   the network; of patches one each

References: Jin et al., A pixel-based framework for data-driven clothing, SCA 2020.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int32
from torch import Tensor, nn

from capture4d.body.skinning import pose_frame, with_shape
from capture4d.captures.animations.known_poses import PoseRange
from capture4d.errors import InputError
from capture4d.files.json_values import entry, number, text, texts, whole
from capture4d.files.reading import reading
from capture4d.files.records import load_body, load_garment, save_body, save_garment
from capture4d.files.tensors import TensorFile, read_tensors, write_tensors
from capture4d.learning.checkpoints import filled
from capture4d.learning.networks import ImageDecoder
from capture4d.types import Body, Garment, PoseSequence
from capture4d.value_checks import require_array, require_finite
from wrinkles.offset_images.canvas import OffsetSampler, Window
from wrinkles.offset_images.config import DrapeOffsetsConfig, PatchConfig, StripConfig
from wrinkles.offset_images.frames import CM, pose_rows
from wrinkles.offset_images.kernels import PoseKernels
from wrinkles.offset_images.layout import OffsetLayout, decode, worn_part
from wrinkles.offset_images.networks import (
    FullyConnected,
    PcaFullyConnected,
    patch_decoder,
    strip_decoder,
    whole_decoder,
)
from wrinkles.offset_images.patches import OffsetFilter, cut_windows, stitched, strip_window
from wrinkles.offset_images.training import predicted_offsets

__all__ = [
    "DrapeOffsets",
    "ModelParts",
    "load_drape_offsets",
    "made_decoder",
    "network_path",
    "save_model_parts",
    "save_network",
    "windows_of",
]

MODEL = "model.safetensors"
KIND, NETWORK_KIND = "offsets of drapes", "a network of drapes' offsets"
STRIP_PADDING = 8
"""Texels around a strip that its loss covers as well, where they show padding."""


def network_path(folder: Path, index: int) -> Path:
    """Where a network is kept, counted from 0."""
    return folder / "networks" / f"{index + 1:02d}.safetensors"


def windows_of(
    layout: OffsetLayout, config: DrapeOffsetsConfig, labels: Int32[np.ndarray, " F"] | None
) -> tuple[Window | None, ...]:
    """What each network draws: None all there is. No windows where nothing but kernels is wanted."""
    match config.network:
        case "patches":
            assert labels is not None
            return cut_windows(layout, labels, config.patch.texels, config.patch.context)
        case "strip":
            return (strip_window(layout, config.strip.rows, config.strip.columns, STRIP_PADDING),)
        case "kernels":
            return ()
        case _:
            return (None,)


def made_decoder(config: DrapeOffsetsConfig, pose_size: int, window: Window | None) -> ImageDecoder:
    """A decoder with random weights: of both images, of a strip, or of a patch."""
    match config.network:
        case "patches":
            patch = config.patch
            return patch_decoder(pose_size, patch.texels, channels=patch.channels, shuffled=config.shuffled)
        case "strip":
            assert window is not None
            return strip_decoder(pose_size, window.rows, window.columns, channels=config.strip.channels)
        case _:
            return whole_decoder(pose_size, config.texels, shuffled=config.shuffled)


@dataclass(frozen=True, slots=True, eq=False)
class ModelParts:
    """What of a model is known before its networks have learned, and what they are combined with."""

    config: DrapeOffsetsConfig
    garment: Garment
    body: Body
    shape: Float32[np.ndarray, " shapes"]
    """Of the person."""
    joint_names: tuple[str, ...]
    """Whose rotations are seen, in this order."""
    labels: Int32[np.ndarray, " F"] | None
    """Of the patches."""
    kernels: PoseKernels | None
    filter: OffsetFilter | None
    learned: PoseRange
    """The poses of the drapes, mirrored ones among them if they were learned."""


@dataclass(frozen=True, slots=True, eq=False)
class DrapeOffsets:
    """A garment that has been learned: its vertices in any pose of the person it was draped on."""

    parts: ModelParts
    layout: OffsetLayout
    networks: Sequence[nn.Module]
    samplers: Sequence[OffsetSampler]
    """What is read of each network."""

    @staticmethod
    def create(parts: ModelParts, layout: OffsetLayout, networks: Sequence[nn.Module]) -> DrapeOffsets:
        windows = windows_of(layout, parts.config, parts.labels)
        return DrapeOffsets(parts, layout, networks, [OffsetSampler(layout, window) for window in windows])

    def stitched_offsets(self, pose: Float[Tensor, "frames pose"]) -> Float[Tensor, "frames P 3"]:
        """`offsets` before the filter of patches."""
        parts, config = self.parts, self.parts.config
        guess = None if parts.kernels is None else parts.kernels.offsets(pose)
        if not self.networks:
            assert guess is not None
            return guess
        made = [
            predicted_offsets(network, sampler, pose)
            for network, sampler in zip(self.networks, self.samplers, strict=True)
        ]
        if len(made) == 1 and config.network != "patches":
            own = made[0]
        else:
            own = stitched(self.layout, list(zip(self.samplers, made, strict=True)))
        if guess is None:
            return own
        return guess + own if config.residual else (guess + own) / 2

    def offsets(self, pose: Float[Tensor, "frames pose"]) -> Float[Tensor, "frames P 3"]:
        """Offsets of all cloth pixels, centimetres.

        Args:
            pose: rotation matrices of the model's joints, flattened.
        """
        made = self.stitched_offsets(pose)
        return made if self.parts.filter is None else self.parts.filter(made)

    def vertices(self, poses: PoseSequence) -> Float64[np.ndarray, "frames V 3"]:
        """The garment in every pose of a motion of the body, metres.

        Raises:
            InputError: the motion is of another skeleton.
        """
        body = self.parts.body
        if poses.joint_names != body.joint_names:
            raise InputError("poses: expected the joints of the body that the garment was draped on, found others")
        joints = [body.joint_names.index(name) for name in self.parts.joint_names]
        near, skin = worn_part(self.layout, body)
        person = with_shape(skin, self.parts.shape)
        found = np.empty((len(poses.frame_ids), len(self.layout.garment.template.vertices), 3))
        for start in range(0, len(found), 64):
            rows = range(start, min(start + 64, len(found)))
            offsets = self.offsets(pose_rows(poses.rotations[rows], joints)).double().numpy() / CM
            for row, own in zip(rows, offsets, strict=True):
                anchors = near.anchors(pose_frame(person, poses, row), self.parts.config.space)
                found[row] = self.layout.vertices(decode(anchors, own))
        return found


def save_network(path: Path, network: nn.Module, history: Sequence[Mapping[str, Any]]) -> None:
    """Write a network's weights and how it learned."""
    weights = {name: each.numpy(force=True) for name, each in network.state_dict().items()}
    write_tensors(path, NETWORK_KIND, weights, {"history": list(history)})


def load_network(path: Path, parts: ModelParts, layout: OffsetLayout, window: Window | None) -> nn.Module:
    """Read a network of a model.

    Raises:
        InputError: it is missing, damaged, or of another architecture.
    """
    file, config, pose_size = read_tensors(path, NETWORK_KIND), parts.config, 9 * len(parts.joint_names)

    def make() -> nn.Module:
        match config.network:
            case "direct":
                return FullyConnected(pose_size, len(layout.vertex))
            case "pca":
                return PcaFullyConnected(pose_size, len(layout.vertex), components=len(file["basis"]))
            case _:
                return made_decoder(config, pose_size, window)

    network = filled(make, {name: torch.from_numpy(each) for name, each in file.tensors.items()}, source=path)
    if isinstance(network, ImageDecoder):
        network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    return network.eval()


def save_model_parts(folder: Path, parts: ModelParts) -> list[Path]:
    """Write all of a model but its networks; the files."""
    config = parts.config
    names = ("network", "space", "texels", "shuffled", "residual", "partner")
    note: dict[str, Any] = {name: getattr(config, name) for name in names}
    note |= {"patch": asdict(config.patch), "strip": asdict(config.strip), "joints": list(parts.joint_names)}
    note["validated_deg"] = parts.learned.validated_deg
    tensors: dict[str, np.ndarray] = {"shape": parts.shape, "learned": parts.learned.quaternions}
    if parts.labels is not None:
        tensors["labels"] = parts.labels
    if (kernels := parts.kernels) is not None:
        note["kernels"] = {"width": kernels.width, "line": kernels.line}
        tensors |= {f"kernels.{name}": getattr(kernels, name) for name in ("poses", "answers", "mean", "basis")}
    if (kept := parts.filter) is not None:
        tensors |= {"filter.mean": kept.mean, "filter.basis": kept.basis}
    save_garment(folder / "garment.npz", parts.garment)
    save_body(folder / "body.npz", parts.body)
    write_tensors(folder / MODEL, KIND, tensors, note)
    return [folder / name for name in ("garment.npz", "body.npz", MODEL)]


def load_drape_offsets(folder: Path) -> DrapeOffsets:
    """Read a garment that `offsets train` wrote.

    Raises:
        InputError: files are missing, damaged, or do not fit together.
    """
    garment, body = load_garment(folder / "garment.npz"), load_body(folder / "body.npz")
    file = read_tensors(folder / MODEL, KIND)
    with reading(file.path, "model of offsets"):
        parts = _parts(file, garment, body)
        layout = OffsetLayout.create(garment, parts.config.texels)
        _require_fit(parts, layout)
        windows = windows_of(layout, parts.config, parts.labels)
    networks = [
        load_network(network_path(folder, index), parts, layout, window) for index, window in enumerate(windows)
    ]
    return DrapeOffsets.create(parts, layout, networks)


def _parts(file: TensorFile, garment: Garment, body: Body) -> ModelParts:
    kinds: dict[str, Any] = {"network": text, "space": text, "texels": whole, "shuffled": whole}
    known = {name: read(file.entry(name), name) for name, read in kinds.items()}
    sizes = {
        name: {key: whole(entry(file.entry(name), key), f"{name}.{key}") for key in keys}
        for name, keys in (("patch", PatchConfig.__dataclass_fields__), ("strip", StripConfig.__dataclass_fields__))
    }
    config = DrapeOffsetsConfig(
        **known, residual=file.entry("residual"), partner=file.entry("partner"),
        patch=PatchConfig(**sizes["patch"]), strip=StripConfig(**sizes["strip"]),
    )  # fmt: skip
    joints, shape = texts(file.entry("joints"), "joints"), file["shape"]
    if not joints or any(name not in body.joint_names for name in joints):
        raise InputError("joints: expected names of the body's, found others")
    require_array("model", "shape", shape, (None,), np.float32)
    require_finite("model", "shape", shape)
    if len(shape) > len(body.shape_directions):
        raise InputError(f"shape: expected at most {len(body.shape_directions)} numbers, found {len(shape)}")
    labels, kernels, kept = file.get("labels"), None, None
    if "kernels" in file.note:
        about = file.entry("kernels")
        arrays = {name: file[f"kernels.{name}"] for name in ("poses", "answers", "mean", "basis")}
        width, line = (number(entry(about, name), name) for name in ("width", "line"))
        if width <= 0:
            raise InputError(f"width: expected a positive number, found {width}")
        kernels = PoseKernels(**arrays, width=width, line=line)
    if "filter.mean" in file.tensors:
        kept = OffsetFilter(file["filter.mean"], file["filter.basis"])
    learned, validated = file["learned"], number(file.entry("validated_deg"), "validated_deg")
    require_array("model", "learned", learned, (None, len(joints), 4), np.float32)
    require_finite("model", "learned", learned)
    if validated < 0:
        raise InputError(f"validated_deg: expected no less than 0, found {validated:g}")
    known = PoseRange(learned, tuple(body.joint_names.index(name) for name in joints), validated)
    return ModelParts(config, garment, body, shape, joints, labels, kernels, kept, known)


def _require_fit(parts: ModelParts, layout: OffsetLayout) -> None:
    """Raises InputError unless the arrays of a model are as large as its garment and poses."""
    config, values, pose = parts.config, 3 * len(layout.vertex), 9 * len(parts.joint_names)
    if config.network == "patches":
        require_array("model", "labels", parts.labels, (len(layout.faces),), np.int32)
    if parts.kernels is None and (config.network == "kernels" or config.residual or config.partner):
        raise InputError("expected kernels, found none")
    checked: list[tuple[str, np.ndarray, tuple[int | None, ...]]] = []
    if (kernels := parts.kernels) is not None:
        count, directions = len(kernels.poses), len(kernels.basis)
        checked += [("poses", kernels.poses, (None, pose)), ("answers", kernels.answers, (count, directions)),
                    ("mean", kernels.mean, (values,)), ("basis", kernels.basis, (None, values))]  # fmt: skip
    if (kept := parts.filter) is not None:
        checked += [("filter.mean", kept.mean, (values,)), ("filter.basis", kept.basis, (None, values))]
    for name, array, shape in checked:
        require_array("model", name, array, shape, np.float32)
        require_finite("model", name, array)
