"""Models whose weights are drawn at random, within bounds as learned ones are: what answers are compared on, and timed.

How good an answer is they do not tell; how it is computed, and how long that takes, is as with learned ones.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from capture4d.files.records import save_body
from capture4d.types import BlendshapeModel, Body, Garment
from retarget.animation.garment_model import GarmentModel
from retarget.config import ControlConfig, LstmConfig
from retarget.model_folder import KERNEL, LINEAR, LSTM, MODEL, POSES, shapes_digest
from retarget.regression.controls import ControlLayout
from retarget.regression.kernel import KernelRegressor, save_kernel
from retarget.regression.known_range import (
    CoefficientRange,
    ControlRange,
    KnownRange,
    PoseRange,
    save_known_range,
)
from retarget.regression.linear import LinearRegressor, save_linear
from retarget.regression.lstm import EncoderDecoder, LstmRegressor, save_lstm
from retarget.regression.regressors import Scales, Trust
from retarget.shapes.files import save_blendshapes

__all__ = ["garment_model", "save_garment_model"]


def garment_model(
    body: Body, garment: Garment, rng: np.random.Generator, *, shapes: int, frames: int, network: LstmConfig,
    fps: float = 25.0,
) -> GarmentModel:  # fmt: skip
    """A learned garment with every kind of regressor.

    Args:
        garment: bound to the body, with skin weights.
        shapes: directions.
        frames: that kernels and pose range have learned from.
    """
    mesh, hung = garment.template, garment.skin_weights
    assert hung is not None
    flat = np.linalg.qr(rng.standard_normal((3 * len(mesh.vertices), shapes)))[0].T
    std = rng.uniform(0.05, 0.3, shapes).astype(np.float32)
    basis = flat.reshape(shapes, -1, 3).astype(np.float32)
    model = BlendshapeModel(garment, mesh.vertices, basis, std, body.joint_names, fps, "CC0-1.0")
    few = ControlLayout.create(body, hung, fps, ControlConfig())
    many = ControlLayout.create(body, hung, fps, ControlConfig(whole_rotations=True, lags=(2, 4)))

    def scales(layout: ControlLayout) -> Scales:
        spread = rng.uniform(0.2, 1, layout.size)
        return Scales(rng.normal(0, 0.1, layout.size).astype(np.float32), spread.astype(np.float32), std)

    def known(layout: ControlLayout, trust: Trust) -> ControlRange:
        largest = [rng.uniform(0.5, 2) if moves else 0.0 for _, _, moves in layout.parts]
        poses = 0.3 * rng.standard_normal((frames, len(layout.pose_columns)))
        mean = rng.normal(0, 0.1, layout.size)
        return ControlRange(mean.astype(np.float32), np.array(largest, np.float32), poses.astype(np.float32), trust)

    middle = rng.normal(0, 0.02, shapes).astype(np.float32)
    matrix = rng.normal(0, 0.5 / few.size, (few.size, shapes)).astype(np.float32)
    linear = LinearRegressor(few, scales(few), matrix, middle, 0.1)
    views = tuple(rng.normal(0, 1 / many.size**0.5, (many.size, width)).astype(np.float32) for width in (6, 4, 3))
    learned = rng.standard_normal((frames, many.size)).astype(np.float32)
    answers = rng.normal(0, 0.1, (frames, shapes)).astype(np.float32)
    shares = np.array([1, 0.5, 2], np.float32)
    kernel = KernelRegressor(many, scales(many), views, shares, 0.1, learned, answers, middle, 0.15)
    torch.manual_seed(int(rng.integers(2**31)))
    lstm = LstmRegressor(few, scales(few), network, EncoderDecoder(few.size, shapes, network).eval(), linear)
    trust = Trust(np.array([[0, 1], [8, 0.9], [8, 0.7], [30, 0.2], [60, 0]], np.float32))
    ranges = CoefficientRange(std, 2 * std, 2.5, rng.normal(0, 0.01, shapes).astype(np.float32))
    still = np.zeros((1, len(few.joints), 4), np.float32)
    still[..., 3] = 1
    limits = KnownRange(
        PoseRange(still, few.joints, 12.0), {"linear": known(few, Trust.whole()), "kernel": known(many, trust)}, ranges
    )
    return GarmentModel(Path(), model, body, linear, kernel, lstm, limits, {}, "")


def save_garment_model(folder: Path, model: GarmentModel) -> None:
    """Write it as `fit` would."""
    folder.mkdir(parents=True, exist_ok=True)
    save_blendshapes(folder / MODEL, model.model)
    digest = shapes_digest(folder)
    save_linear(folder / LINEAR, model.linear, model_digest=digest)
    assert model.kernel is not None
    save_kernel(folder / KERNEL, model.kernel, model_digest=digest)
    assert isinstance(model.lstm, LstmRegressor)
    save_lstm(folder / LSTM, model.lstm, model_digest=digest)
    save_known_range(folder / POSES, model.limits, model_digest=digest)
    save_body(folder / "body.npz", model.body)
