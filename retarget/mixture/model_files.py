"""A learned garment with styles as a folder.

garment.npz            the first prototype's garment, whose binding is that of all
body.npz               the body
styles.safetensors     networks, kernels, directions, and what they are told
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from capture4d.captures.animations.known_poses import PoseRange
from capture4d.captures.drapes.style_sets import Ranges
from capture4d.errors import InputError
from capture4d.files.json_values import entry, number, text, whole, wholes
from capture4d.files.reading import reading
from capture4d.files.records import load_body, load_garment, save_body, save_garment
from capture4d.files.tensors import TensorFile, read_tensors, write_tensors
from capture4d.learning.checkpoints import filled
from capture4d.value_checks import require_array, require_finite
from retarget.mixture.config import MODEL, NetworkConfig
from retarget.mixture.heads import Head, PoseNumbers
from retarget.mixture.kernel_ridge import KernelRidge
from retarget.mixture.predictors import Ensemble, Mixture, Predictor
from retarget.mixture.styled_garment import Canonical, StyledGarment
from retarget.mixture.training import made_network

__all__ = ["MODEL_FILES", "load_styled_garment", "save_styled_garment"]

MODEL_FILES = ("garment.npz", "body.npz", MODEL)
KIND = "a garment with styles"


def save_styled_garment(folder: Path, garment: StyledGarment) -> list[Path]:
    """Write a garment into a folder; the files, in the order in which they were written."""
    save_garment(folder / "garment.npz", garment.garment)
    save_body(folder / "body.npz", garment.body)
    tensors: dict[str, np.ndarray] = {
        "pose.mean": garment.pose.mean,
        "pose.scale": garment.pose.scale,
        "learned": garment.learned.quaternions,
    }
    note: dict[str, Any] = {
        "style": [[name, low, high] for name, (low, high) in garment.ranges.style.items()],
        "shape": [[low, high] for low, high in garment.ranges.shape],
        "pose": garment.pose.kind,
        "joints": list(garment.pose.joints),
        "over_drape": garment.over_drape,
        "validated_deg": garment.learned.validated_deg,
        "networks": {},
        "kernels": {},
        "heads": {},
    }
    tensors["a_pose.mean"] = garment.canonical.mean
    _put_regression(tensors, note, "a_pose", garment.canonical.regression)
    predictor = garment.predictor
    if isinstance(predictor, Ensemble):
        note |= {"method": "ensemble", "members": len(predictor.networks), "style_weight": predictor.style_weight}
        _put_head(tensors, note, "head", predictor.head)
        for k, network in enumerate(predictor.networks):
            _put_regression(tensors, note, f"network-{k}", network)
        if predictor.kernels is not None:
            _put_regression(tensors, note, "kernels", predictor.kernels)
    else:
        note |= {"method": "mixture", "members": len(predictor.high), "bandwidth": predictor.bandwidth,
                 "normalised": predictor.normalised}  # fmt: skip
        tensors["prototypes"] = predictor.prototypes
        _put_head(tensors, note, "low_head", predictor.low_head)
        _put_head(tensors, note, "high_head", predictor.high_head)
        _put_regression(tensors, note, "low", predictor.low)
        for k, network in enumerate(predictor.high):
            _put_regression(tensors, note, f"high-{k}", network)
    write_tensors(folder / MODEL, KIND, tensors, note)
    return [folder / "garment.npz", folder / "body.npz", folder / MODEL]


def load_styled_garment(folder: Path) -> StyledGarment:
    """Read a garment that `fit-styles` wrote.

    Raises:
        InputError: a file is missing, damaged or something else, or they do not fit together.
    """
    path = folder / MODEL
    file = read_tensors(path, KIND)
    garment, body = load_garment(folder / "garment.npz"), load_body(folder / "body.npz")
    count = len(garment.template.vertices)
    with reading(path, "model"):
        weights = garment.skin_weights
        if weights is None or weights.shape[1] != len(body.joint_names):
            raise InputError("garment.npz: expected a garment that is bound to the joints of body.npz, found another")
        ranges, pose = _ranges(file), _pose(file, len(body.joint_names))
        told = len(pose.mean) + ranges.size
        mean = _array(file, "a_pose.mean", (count, 3))
        canonical = Canonical(_regression(file, "a_pose", ranges.size, 3 * count), mean)
        predictor = _predictor(file, count, (len(pose.mean), told))
        return StyledGarment(
            garment, body, ranges, pose, canonical, predictor, _flag(file, "over_drape"), _learned(file, pose.joints)
        )


# --- pieces ------------------------------------------------------------------------------------------------------


def _put_head(tensors: dict[str, np.ndarray], note: dict[str, Any], name: str, head: Head) -> None:
    note["heads"][name] = {"scale": head.scale}
    tensors[f"{name}.mean"] = head.mean
    if head.directions is not None:
        tensors[f"{name}.directions"] = head.directions


def _put_regression(
    tensors: dict[str, np.ndarray], note: dict[str, Any], name: str, found: KernelRidge | nn.Sequential
) -> None:
    if isinstance(found, KernelRidge):
        note["kernels"][name] = {"length": found.length, "line": found.line}
        tensors |= {f"{name}.points": found.points, f"{name}.answers": found.answers}
        return
    tensors |= {f"{name}.{key}": value.numpy(force=True) for key, value in found.state_dict().items()}
    dropout = [layer.p for layer in found if isinstance(layer, nn.Dropout)]
    note["networks"][name] = {"dropout": dropout[0] if dropout else 0.0}


def _array(file: TensorFile, name: str, shape: tuple[int | None, ...]) -> np.ndarray:
    found = file[name]
    require_array("model", name, found, shape, np.float64)
    require_finite("model", name, found)
    return found


def _flag(file: TensorFile, name: str) -> bool:
    found = file.entry(name)
    if not isinstance(found, bool):
        raise InputError(f"{name}: expected true or false, found something else")
    return found


def _positive(value: Any, name: str) -> float:
    found = number(value, name)
    if found <= 0:
        raise InputError(f"{name}: expected a positive number, found {found:g}")
    return found


def _ranges(file: TensorFile) -> Ranges:
    styles, shapes = file.entry("style"), file.entry("shape")
    if not isinstance(styles, list) or not isinstance(shapes, list):
        raise InputError("style, shape: expected lists of ranges, found something else")

    def limits(row: Any, size: int) -> tuple[float, float]:
        if not isinstance(row, list) or len(row) != size:
            raise InputError(f"style, shape: expected {size} entries of a range, found something else")
        low, high = (number(each, "range") for each in row[-2:])
        if low > high or (size == 3 and low == high):
            raise InputError(f"range: expected the least first, found {low:g} and {high:g}")
        return low, high

    found = Ranges({text(row[0], "style"): limits(row, 3) for row in styles if isinstance(row, list) and row},
                   [limits(row, 2) for row in shapes])  # fmt: skip
    if not found.size or len(found.style) != len(styles):
        raise InputError("style, shape: expected ranges with names of their own, found none or others")
    return found


def _pose(file: TensorFile, joints: int) -> PoseNumbers:
    chosen, kind = wholes(file.entry("joints"), "joints"), text(file.entry("pose"), "pose")
    if kind not in ("matrices", "axis-angle"):
        raise InputError(f"pose: expected matrices or axis-angle, found '{kind[:40]}'")
    if any(joint >= joints for joint in chosen):
        raise InputError(f"joints: expected some of {joints}, found {max(chosen)}")
    size = len(chosen) * (9 if kind == "matrices" else 3)
    mean, scale = _array(file, "pose.mean", (size,)), _array(file, "pose.scale", (size,))
    if (scale <= 0).any():
        raise InputError("pose.scale: expected positive numbers, found others")
    return PoseNumbers(chosen, "matrices" if kind == "matrices" else "axis-angle", mean, scale)


def _learned(file: TensorFile, joints: tuple[int, ...]) -> PoseRange:
    quaternions, validated = file["learned"], number(file.entry("validated_deg"), "validated_deg")
    require_array("model", "learned", quaternions, (None, len(joints), 4), np.float32)
    if (np.abs(np.linalg.norm(quaternions.astype(np.float64), axis=2) - 1) > 1e-3).any():
        raise InputError("learned: expected unit quaternions, found others")
    if validated < 0:
        raise InputError(f"validated_deg: expected no less than 0, found {validated:g}")
    return PoseRange(quaternions, joints, validated)


def _head(file: TensorFile, name: str, count: int) -> Head:
    scale = _positive(entry(entry(file.entry("heads"), name), "scale"), f"{name}.scale")
    mean = _array(file, f"{name}.mean", (3 * count,))
    whole_ = f"{name}.directions"
    return Head(mean, _array(file, whole_, (None, 3 * count)) if whole_ in file.tensors else None, scale)


def _regression(file: TensorFile, name: str, inputs: int, outputs: int) -> KernelRidge | nn.Sequential:
    kernels = file.entry("kernels")
    if isinstance(kernels, Mapping) and name in kernels:
        about = kernels[name]
        points = _array(file, f"{name}.points", (None, inputs))
        answers = _array(file, f"{name}.answers", (len(points), outputs))
        return KernelRidge(points, answers, _positive(entry(about, "length"), f"{name}.length"),
                           number(entry(about, "line"), f"{name}.line"))  # fmt: skip
    return _network(file, name, inputs, outputs)


def _network(file: TensorFile, name: str, inputs: int, outputs: int) -> nn.Sequential:
    dropout = number(entry(entry(file.entry("networks"), name), "dropout"), f"{name}.dropout")
    if not 0 <= dropout < 1:
        raise InputError(f"{name}.dropout: expected a share below 1, found {dropout:g}")
    hidden = file[f"{name}.0.bias"].shape[0] if file[f"{name}.0.bias"].ndim == 1 else 0
    if not hidden:
        raise InputError(f"{name}: expected a layer, found none")
    config = NetworkConfig(hidden=hidden, dropout=dropout)
    weights = {key: torch.from_numpy(each) for key, each in file.prefixed(f"{name}.").items()}
    network = filled(lambda: made_network(inputs, outputs, config), weights, source=file.path)
    return network.eval()


def _predictor(file: TensorFile, count: int, inputs: tuple[int, int]) -> Predictor:
    """What answers.

    Args:
        inputs: numbers of a pose, and of a pose with style and shape.
    """
    method, members = file.entry("method"), whole(file.entry("members"), "members", most=10_000)
    if method == "ensemble":
        head = _head(file, "head", count)
        networks = [_network(file, f"network-{k}", inputs[1], head.outputs) for k in range(members)]
        kernels = None
        if "kernels.points" in file.tensors:
            kernels = _regression(file, "kernels", inputs[1], head.outputs)
            if not isinstance(kernels, KernelRidge):
                raise InputError("kernels: expected kernels, found a network")
        if not networks and kernels is None:
            raise InputError("members: expected networks or kernels, found neither")
        return Ensemble(head, networks, kernels, number(file.entry("style_weight"), "style_weight"))
    if method != "mixture":
        raise InputError("method: expected ensemble or mixture, found another")
    low_head, high_head = _head(file, "low_head", count), _head(file, "high_head", count)
    prototypes = _array(file, "prototypes", (members, count, 3))
    if not members:
        raise InputError("members: expected at least one prototype, found none")
    low = _network(file, "low", inputs[1], low_head.outputs)
    high = [_network(file, f"high-{k}", inputs[0], high_head.outputs) for k in range(members)]
    bandwidth = _positive(file.entry("bandwidth"), "bandwidth")
    return Mixture(low_head, low, high_head, high, prototypes, bandwidth, _flag(file, "normalised"))
