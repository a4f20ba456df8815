"""Learned models as small as they come: what the kinds of `benchmarks.reader_kinds` write."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.reader_values import BODY, GARMENT, MESH, NAMES, PARENTS, RNG
from capture4d.types import Garment, Mesh

__all__ = ["MODELS"]

DIGEST, SHAPES = "aa", 2


def _layout() -> Any:
    from retarget.config import ControlConfig
    from retarget.regression.controls import ControlLayout

    return ControlLayout(NAMES, (1, 2), 60.0, ControlConfig(), tuple(int(parent) for parent in PARENTS))


def _scales(size: int) -> Any:
    from retarget.regression.regressors import Scales

    return Scales(np.zeros(size, np.float32), np.ones(size, np.float32), np.ones(SHAPES, np.float32))


def _write_linear(path: Path) -> None:
    from retarget.regression.linear import LinearRegressor, save_linear

    layout = _layout()
    matrix = RNG.random((layout.size, SHAPES), np.float32)
    save_linear(path, LinearRegressor(layout, _scales(layout.size), matrix, np.zeros(SHAPES, np.float32), 0.1),
                model_digest=DIGEST)  # fmt: skip


def _read_linear(path: Path) -> Any:
    from retarget.regression.linear import load_linear

    return load_linear(path, model_digest=DIGEST)


def _write_kernel(path: Path) -> None:
    from retarget.regression.kernel import KernelRegressor, save_kernel

    layout = _layout()
    frames, answers = RNG.random((3, layout.size), np.float32), RNG.random((3, SHAPES), np.float32)
    views, shares = (RNG.random((layout.size, 2), np.float32),), np.ones(1, np.float32)
    regressor = KernelRegressor(
        layout, _scales(layout.size), views, shares, 0.5, frames, answers, np.zeros(SHAPES, np.float32), 0.1
    )
    save_kernel(path, regressor, model_digest=DIGEST)


def _read_kernel(path: Path) -> Any:
    from retarget.regression.kernel import load_kernel

    return load_kernel(path, model_digest=DIGEST)


def _write_lstm(path: Path) -> None:
    from retarget.config import LstmConfig
    from retarget.regression.lstm import EncoderDecoder, LstmRegressor, save_lstm

    layout, config = _layout(), LstmConfig(size=4, over_linear=False)
    network = EncoderDecoder(layout.size, SHAPES, config)
    save_lstm(path, LstmRegressor(layout, _scales(layout.size), config, network), model_digest=DIGEST)


def _read_lstm(path: Path) -> Any:
    from retarget.regression.lstm import load_lstm

    return load_lstm(path, model_digest=DIGEST)


def _write_range(path: Path) -> None:
    from capture4d.captures.animations.known_poses import PoseRange
    from retarget.regression.known_range import CoefficientRange, ControlRange, KnownRange, save_known_range

    layout = _layout()
    still = np.tile(np.array([0, 0, 0, 1], np.float32), (3, 2, 1))
    poses = RNG.random((3, len(layout.pose_columns)), np.float32)
    controls = ControlRange(np.zeros(layout.size, np.float32), np.ones(len(layout.parts), np.float32), poses)
    coefficients = CoefficientRange(np.ones(SHAPES, np.float32), np.ones(SHAPES, np.float32), 2.0)
    known = KnownRange(PoseRange(still, (1, 2), 5.0), {"linear": controls, "kernel": controls}, coefficients)
    save_known_range(path, known, model_digest=DIGEST)


def _read_range(path: Path) -> Any:
    from retarget.regression.known_range import load_known_range

    return load_known_range(path, model_digest=DIGEST)


def _write_generator(path: Path) -> None:
    from wrinkles.normal_maps.config import MapConfig, NetworkConfig
    from wrinkles.normal_maps.inference import WrinkleModel, save_model
    from wrinkles.normal_maps.networks import UNet

    config = NetworkConfig(filters=1, layers=3)
    save_model(path, WrinkleModel(UNet(config), config, texels=8, maps=MapConfig(size=8), layout_digest="bb",
                                  template=MESH))  # fmt: skip


def _read_generator(path: Path) -> Any:
    from wrinkles.normal_maps.inference import load_model

    return load_model(path)


def _garment_of_islands() -> Garment:
    """With UVs in which a face is an island of three pixels."""
    apart = np.arange(3, dtype=np.float32)[:, None, None] / 3
    uv = apart + np.array([[0, 0], [0.25, 0], [0, 0.25]], np.float32)
    return replace(GARMENT, template=Mesh(MESH.vertices, MESH.faces, uv))


def _write_offsets(path: Path, *, baseline: bool) -> None:
    from wrinkles.offset_images.layout import OffsetLayout
    from wrinkles.offset_images.model_files import OffsetModel, save_offset_model
    from wrinkles.offset_images.networks import PcaFullyConnected, image_decoder

    joints, layout = np.array([1, 2]), OffsetLayout.create(_garment_of_islands(), 64)
    pixels = len(layout.vertex)
    network = PcaFullyConnected(18, pixels, components=2, hidden=256) if baseline else image_decoder(18, 64)
    save_offset_model(path, OffsetModel(network, joints, layout, [{"epoch": 1, "loss": 0.5}]))


def _read_offsets(path: Path) -> Any:
    from wrinkles.offset_images.model_files import load_offset_model

    return load_offset_model(path, _garment_of_islands())


def _write_styles(path: Path, *, method: str) -> None:
    """A model's folder; garment and body lie beside what is damaged."""
    from capture4d.captures.animations.known_poses import PoseRange
    from capture4d.captures.drapes.style_sets import Ranges
    from retarget.mixture.config import NetworkConfig
    from retarget.mixture.heads import Head, PoseNumbers
    from retarget.mixture.kernel_ridge import KernelRidge
    from retarget.mixture.model_files import save_styled_garment
    from retarget.mixture.predictors import Ensemble, Mixture
    from retarget.mixture.styled_garment import Canonical, StyledGarment
    from retarget.mixture.training import made_network

    count, config = 3 * len(MESH.vertices), NetworkConfig(hidden=2)
    pose = PoseNumbers((1,), "axis-angle", np.zeros(3), np.ones(3))
    canonical = Canonical(KernelRidge(RNG.random((2, 2)), RNG.random((2, count)), 1.0, 0.5), np.zeros((count // 3, 3)))
    head = Head(np.zeros(count), RNG.random((2, count)), 0.1)
    kernels = KernelRidge(RNG.random((3, 5)), RNG.random((3, 2)), 1.0, 0.0)
    ensemble = Ensemble(head, [made_network(5, 2, config)], kernels, 2.0)
    mixture = Mixture(head, made_network(5, 2, config), head, [made_network(3, 2, config)],
                      RNG.random((1, count // 3, 3)), 0.01, True)  # fmt: skip
    ranges = Ranges({"length": (0.4, 0.8)}, [(-1.0, 1.0)])
    predictor = ensemble if method == "ensemble" else mixture
    known = PoseRange(np.tile(np.array([0, 0, 0, 1], np.float32), (2, 1, 1)), (1,), 5.0)
    save_styled_garment(path.parent, StyledGarment(GARMENT, BODY, ranges, pose, canonical, predictor, True, known))


def _read_styles(path: Path) -> Any:
    from retarget.mixture.model_files import load_styled_garment

    return load_styled_garment(path.parent)


def _write_drape_offsets(path: Path) -> None:
    """A model of kernels; garment and body lie beside what is damaged."""
    from capture4d.captures.animations.known_poses import PoseRange
    from wrinkles.offset_images.config import DrapeOffsetsConfig
    from wrinkles.offset_images.drape_model import ModelParts, save_model_parts
    from wrinkles.offset_images.kernels import PoseKernels

    garment = _garment_of_islands()
    poses, dual, mean, components = (RNG.random(size, np.float32) for size in ((4, 18), (4, 2), (27,), (2, 27)))
    kernels = PoseKernels(poses, dual, mean, components, 1.0, 0.1)
    config = DrapeOffsetsConfig(network="kernels", texels=64)
    learned = PoseRange(np.tile(np.array([0, 0, 0, 1], np.float32), (4, 2, 1)), (1, 2), 5.0)
    parts = ModelParts(config, garment, BODY, np.zeros(2, np.float32), NAMES[1:3], None, kernels, None, learned)
    save_model_parts(path.parent, parts)


def _read_drape_offsets(path: Path) -> Any:
    from wrinkles.offset_images.drape_model import load_drape_offsets

    return load_drape_offsets(path.parent)


MODELS: dict[str, tuple[Callable[[Path], Any], Callable[[Path], Any]]] = {
    "linear": (_write_linear, _read_linear),
    "kernel": (_write_kernel, _read_kernel),
    "lstm": (_write_lstm, _read_lstm),
    "poses": (_write_range, _read_range),
    "generator": (_write_generator, _read_generator),
    "decoder": (partial(_write_offsets, baseline=False), _read_offsets),
    "pca": (partial(_write_offsets, baseline=True), _read_offsets),
    "ensemble/styles": (partial(_write_styles, method="ensemble"), _read_styles),
    "mixture/styles": (partial(_write_styles, method="mixture"), _read_styles),
    "drapes/model": (_write_drape_offsets, _read_drape_offsets),
}
"""How a file of each is written, and read."""
