"""A file answers as the model does: garments within 1e-4 mm, normals within 0.1 degrees."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import torch

from benchmarks.random_models import garment_model
from capture4d.app.onnx_models import stage
from capture4d.app.onnx_models.config import OnnxConfig
from capture4d.app.onnx_models.garments import garment_graph, styled_graph
from capture4d.app.onnx_models.graph import Graph
from capture4d.app.onnx_models.wrinkles import probe_maps, wrinkle_graph
from capture4d.body.skinning import skin, with_pose
from capture4d.errors import InputError
from capture4d.files.optional_packages import ONNX, ONNX_RUNTIME, is_installed, package_module
from capture4d.learning.networks import perceptron
from capture4d.types import Garment
from retarget.config import AnimateConfig, LstmConfig
from retarget.mixture.heads import Head, PoseNumbers
from retarget.mixture.kernel_ridge import KernelRidge
from retarget.mixture.predictors import Ensemble, Mixture
from retarget.mixture.styled_garment import Canonical, StyledGarment
from retarget.regression.known_range import PoseRange
from retarget.shapes.blendshapes import reconstruct
from tests.moving_garment import cloth, limb, motion, weights
from tests.moving_wrinkles import write_wrinkle_model
from wrinkles.normal_maps.config import NetworkConfig
from wrinkles.normal_maps.inference import load_model

pytestmark = pytest.mark.skipif(
    not (is_installed(ONNX) and is_installed(ONNX_RUNTIME)), reason="the extra [onnx] is not installed"
)
FPS = 25.0


def answers(graph: Graph, inputs: dict[str, np.ndarray]) -> list[np.ndarray]:
    runtime: Any = package_module(ONNX_RUNTIME, "")
    session = runtime.InferenceSession(graph.whole_file({"why": "test"}), providers=["CPUExecutionProvider"])
    return session.run(None, inputs)


# --- wrinkles ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("output", ["residual", "absolute"])
@pytest.mark.parametrize("norm", ["instance", "running"])
def test_a_wrinkle_network_paints_the_same_normals(
    output: Literal["residual", "absolute"], norm: Literal["instance", "running"], tmp_path: Path
):
    config = NetworkConfig(filters=6, layers=5, output=output, dropout=0.5, norm_at_test=norm)
    write_wrinkle_model(tmp_path, config)
    model = load_model(tmp_path)
    low = probe_maps(model, 3)
    assert (np.abs(low).sum(axis=1) == 0).any(), "bare places are looked at"
    (high,) = answers(wrinkle_graph(model), {"low": low})
    wanted = torch.stack([model.generate(torch.from_numpy(each), half_precision=False) for each in low]).numpy()
    assert np.abs(wanted - low).max() > 1e-4
    assert np.abs(high - wanted).max() < 1e-4


def test_a_network_of_squares_is_refused(tmp_path: Path):
    write_wrinkle_model(tmp_path, crop=32)
    with pytest.raises(InputError, match="sees whole maps, found one of squares of 32 texels"):
        wrinkle_graph(load_model(tmp_path))


def bound() -> Garment:
    """The tube, every vertex bound to the middle of the same face."""
    mesh, shares = cloth(), np.full((len(cloth().vertices), 3), 1 / 3, np.float32)
    faces = np.zeros(len(shares), np.int32)
    return Garment(mesh, {}, faces, shares, weights(mesh.vertices[:, 1]), np.zeros(1, np.float32))


# --- learned garments --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["linear", "kernel", "lstm", "ensemble"])
@pytest.mark.parametrize("beta", [None, (0.5,)])
def test_a_garment_answers_and_moves_alike_also_far_from_what_it_knows(name: str, beta: tuple[float, ...] | None):
    rng = np.random.default_rng(5)
    model = garment_model(limb(), bound(), rng, shapes=5, frames=30, network=LstmConfig(layers=2, size=16))
    regressor, person = model.regressors[name], model.person(beta)
    controls = np.concatenate([0.3 * rng.standard_normal((12, regressor.layout.size)) * scale for scale in (1, 4)])
    controls = controls.astype(np.float32)
    poses = motion(len(controls), seed=2, fps=FPS, first=1)
    transforms = np.stack(
        [with_pose(person, *each).transforms for each in zip(poses.rotations, poses.translations, strict=True)]
    )
    inputs = {"controls": controls.astype(np.float64), "transforms": transforms}
    vertices, coefficients = answers(garment_graph(model, regressor, beta), inputs)
    wanted = regressor.predict(controls)
    assert np.abs(wanted).max() > 0.01
    assert np.abs(coefficients - wanted).max() < 1e-6 * np.abs(wanted).max() + 1e-7
    hung = model.model.garment.skin_weights
    assert hung is not None
    rest = reconstruct(model.model.mean.astype(np.float64), model.model.basis.astype(np.float64), wanted)
    placed = np.stack([skin(each, hung, frame) for each, frame in zip(rest, transforms, strict=True)])
    assert 1e3 * np.abs(vertices - placed).max() < 1e-4


# --- garments with styles ----------------------------------------------------------------------------------------


def styled(rng: np.random.Generator, kind: Literal["ensemble", "mixture"]) -> StyledGarment:
    from capture4d.captures.drapes.style_sets import Ranges

    body, garment = limb(), bound()
    count = len(garment.template.vertices)
    joints = (1, 2, 3)
    pose = PoseNumbers(joints, "matrices", rng.normal(0, 0.1, 27), rng.uniform(0.2, 1, 27))
    directions = np.linalg.qr(rng.standard_normal((3 * count, 6)))[0].T
    head = Head(0.01 * rng.standard_normal(3 * count), directions, 0.1)
    torch.manual_seed(2)
    a_pose = KernelRidge(rng.standard_normal((4, 2)), 0.01 * rng.standard_normal((4, 3 * count)), 1.0, 0.5)
    canonical = Canonical(a_pose, 0.02 * rng.standard_normal((count, 3)))
    learned = PoseRange(np.zeros((0, 3, 4), np.float32), joints, 10.0)
    ranges = Ranges({"length": (0.4, 0.8)}, [(-1.0, 1.0)])
    if kind == "ensemble":
        kernels = KernelRidge(rng.standard_normal((9, 29)), 0.1 * rng.standard_normal((9, 6)), 4.0, 1e-3)
        networks = [perceptron(29, 12, 6, dropout=0.2) for _ in range(2)]
        predictor: Ensemble | Mixture = Ensemble(head, networks, kernels, 0.7)
    else:
        prototypes = 0.02 * rng.standard_normal((3, count, 3))
        high = [perceptron(27, 12, 6) for _ in range(3)]
        predictor = Mixture(head, perceptron(29, 12, 6), replace(head, scale=0.05), high, prototypes, 0.1, True)
    return StyledGarment(garment, body, ranges, pose, canonical, predictor, kind == "ensemble", learned)


@pytest.mark.parametrize("kind", ["ensemble", "mixture"])
def test_a_garment_with_styles_is_displaced_alike(kind: Literal["ensemble", "mixture"]):
    rng = np.random.default_rng(6)
    garment = styled(rng, kind)
    beta, style = (0.4,), {"length": 0.7}
    worn, numbers = garment.worn(beta, style, AnimateConfig()), garment.ranges.numbers(style, beta)
    rotations = motion(9, seed=4, fps=FPS, first=1).rotations.astype(np.float64)
    transforms = np.stack([with_pose(worn.person, each, np.zeros(3)).transforms for each in rotations])
    (vertices,) = answers(styled_graph(garment, worn, numbers), {"rotations": rotations, "transforms": transforms})
    hung = garment.garment.skin_weights
    assert hung is not None
    unposed = worn.unposed(rotations)
    placed = np.stack([skin(each, hung, frame) for each, frame in zip(unposed, transforms, strict=True)])
    assert 1e3 * np.abs(vertices - placed).max() < 1e-4
    axes = replace(garment, pose=replace(garment.pose, kind="axis-angle"))
    with pytest.raises(InputError, match="told poses as matrices"):
        styled_graph(axes, worn, numbers)


# --- the stage ---------------------------------------------------------------------------------------------------


def test_a_folder_holds_the_file_and_how_far_it_is_off(tmp_path: Path):
    write_wrinkle_model(tmp_path / "model")
    config = OnnxConfig(probes=8)
    result, compared = stage.run(tmp_path / "model", tmp_path / "onnx", config)
    assert compared.unit == "deg"
    assert 0 <= compared.mean <= compared.largest < 0.1
    assert compared.faults == []
    assert compared.onnx_ms > 0
    assert compared.ours_ms > 0
    stamp = (result.path / stage.FILE).stat().st_mtime_ns
    again, told = stage.run(tmp_path / "model", tmp_path / "onnx", config)
    assert (result.path / stage.FILE).stat().st_mtime_ns == stamp
    assert (again.digest, told) == (result.digest, compared)
    with pytest.raises(InputError, match="expected a model"):
        stage.run(tmp_path / "onnx", tmp_path / "other", config)


def test_a_difference_above_the_limit_is_told():
    compared: Callable[[float], stage.Compared] = lambda away: stage.Compared("x", away, 0, "mm", 1, 1, "numpy")  # noqa: E731
    assert compared(2e-4).faults == ["differs by 0.0002 mm > 0.0001"]
    assert compared(float("nan")).faults
    assert compared(9e-5).faults == []
