"""The stage that writes a model as an ONNX file, and compares it with the model: a folder out.

stage.json      what was made, and from what
model.onnx      inputs, outputs, units and licence are in its metadata
onnx.json       by how much it differs from the model, and how long both take
card.json       what it was made from, licence, versions, figures; README.md, the same for people

The runtime, one thread, answers probes that this project answers as well: poses between and beyond the learned ones, or
smooth maps with bare places.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from capture4d.app.onnx_models.config import OnnxConfig
from capture4d.app.onnx_models.garments import garment_graph, styled_graph
from capture4d.app.onnx_models.graph import Graph
from capture4d.app.onnx_models.wrinkles import probe_maps, wrinkle_graph
from capture4d.body.skinning import ShapedBody, skin, with_pose
from capture4d.errors import InputError
from capture4d.files.atomic import file_digest, read_json, write_bytes, write_json
from capture4d.files.optional_packages import ONNX_RUNTIME, package_module
from capture4d.runs.progress import progress
from capture4d.runs.stage import StageResult, open_stage
from retarget.animation.bodies import captured_person, retargeted_mean
from retarget.animation.garment_model import load_garment_model
from retarget.config import AnimateConfig
from retarget.mixture.config import MODEL as STYLES
from retarget.mixture.model_files import MODEL_FILES, load_styled_garment
from retarget.model_folder import MODEL, regressor_files
from retarget.regression.ensemble import EnsembleRegressor
from retarget.regression.known_range import BoundedRegressor
from retarget.regression.regressors import Regressor
from retarget.shapes.blendshapes import reconstruct
from wrinkles.normal_maps.inference import generator_path, load_model

__all__ = ["FILE", "Compared", "run"]

SCHEMA = 1
FILE = "model.onnx"
LIMITS: Mapping[str, float] = {"mm": 1e-4, "deg": 0.1}
"""By how much a file may differ from its model."""
REPEATS = 3
"""Of what is timed, of which the quickest counts."""

Inputs = Mapping[str, np.ndarray]


@dataclass(frozen=True, slots=True)
class Compared:
    """A file beside its model, over all probes."""

    kind: str
    """ "wrinkle network", "garment" or "garment with styles". """
    largest: float
    mean: float
    unit: str
    """Of both: "mm" of a vertex, or "deg" of a normal."""
    onnx_ms: float
    """For a frame or a map, one thread; both do all probes at once."""
    ours_ms: float
    ours_by: str
    """ "numpy" or "torch". """

    @property
    def faults(self) -> list[str]:
        limit = LIMITS[self.unit]
        return [f"differs by {self.largest:.2g} {self.unit} > {limit:g}"] if not self.largest <= limit else []


@dataclass(frozen=True, slots=True, eq=False)
class _Task:
    """A model, ready to be written and compared."""

    kind: str
    graph: Graph
    inputs: Inputs
    output: str
    ours: Callable[[], np.ndarray]
    """The same from the model, in the precision that it is compared in."""
    timed: Callable[[], object]
    """What a user of this project calls."""
    by: str
    files: list[Path]
    licence: str
    about: Mapping[str, str]


def run(model: Path, output: Path, config: OnnxConfig, *, overwrite: bool = False) -> tuple[StageResult, Compared]:
    """Write a model's file, unless it is there.

    Args:
        model: folder of `fit`, `fit-styles` or `wrinkles train`; or a work folder with retarget/.
    Raises:
        InputError: there is no such model, it cannot be written as a graph, or a package is not installed.
    """
    package_module(ONNX_RUNTIME, "")
    torch.set_num_threads(1)
    task = _task(model, config)
    upstream = {"model": file_digest(task.files, root=task.files[0].parent)}
    stage = open_stage(
        output, name="export-onnx", schema=SCHEMA, config=config, upstream=upstream, sources={"model": model},
        overwrite=overwrite,
    )  # fmt: skip
    path, told = stage.path / FILE, stage.path / "onnx.json"
    if not (stage.was_complete and path.is_file() and told.is_file()):
        with progress("onnx", 2) as advance:
            write_bytes(path, task.graph.whole_file({"kind": task.kind, "licence": task.licence, **task.about}))
            advance(1)
            write_json(told, asdict(_compared(path, task, config.probes)))
            advance(1)
    return stage.finish([path]), Compared(**read_json(told))


def _task(model: Path, config: OnnxConfig) -> _Task:
    if (model / STYLES).is_file():
        return _styled(model, config)
    if (model / MODEL).is_file() or (model / "retarget").is_dir():
        return _garment(model, config)
    if generator_path(model).is_file():
        return _network(model, config)
    expected = f"{MODEL}, {STYLES} or generator.safetensors"
    raise InputError(f"expected a model ({expected}), found none", where=model)


def _network(model: Path, config: OnnxConfig) -> _Task:
    known, low = load_model(model), None
    low = probe_maps(known, config.probes)

    def ours() -> np.ndarray:
        made = [known.generate(torch.from_numpy(each), half_precision=False) for each in low]
        return torch.stack(made).numpy().astype(np.float64)

    about = {
        "low": "unit normals in garment coordinates, zero beside the cloth",
        "high": "the same with wrinkles",
        "texels": str(known.texels),
        "layout_digest": known.layout_digest,
        "reference": json.dumps(np.round(known.template.vertices.astype(float), 6).tolist()),
    }
    files = [generator_path(model)]
    return _Task(
        "wrinkle network", wrinkle_graph(known), {"low": low}, "high", ours, ours, "torch", files, "none given", about
    )


def _garment(model: Path, config: OnnxConfig) -> _Task:
    known = load_garment_model(model)
    name = known.best_name if config.regressor == "auto" else config.regressor
    if name not in known.regressors:
        raise InputError(f"--regressor {name}: expected one of {', '.join(known.regressors)}", where=model)
    regressor, beta = known.regressors[name], config.beta or None
    person = known.person(beta)
    mean = retargeted_mean(known.model, captured_person(known.model, known.body), person)
    weights = known.model.garment.skin_weights
    assert weights is not None
    rng = np.random.default_rng(0)
    controls, transforms = _probe_controls(regressor, config.probes, rng), _probe_transforms(person, config.probes, rng)

    def placed(kind: type) -> np.ndarray:
        rest = reconstruct(mean.astype(np.float32).astype(kind), known.model.basis.astype(kind), answered())
        return np.stack([skin(each, weights, frame) for each, frame in zip(rest, transforms, strict=True)])

    def answered() -> np.ndarray:
        return regressor.predict(controls).astype(np.float64)

    inputs = {"controls": controls.astype(np.float64), "transforms": transforms}
    about = {
        "controls": f"control vectors at {known.model.fps:g} frames a second, frame after frame",
        "transforms": f"joints {', '.join(known.model.joint_names)}: rest pose to world, metres",
        "vertices": "metres, world; not taken out of the body",
        "regressor": name,
    }
    files = [known.folder / MODEL, *regressor_files(known.folder, name)]
    return _Task(
        "garment", garment_graph(known, regressor, beta), inputs, "vertices", lambda: placed(np.float64),
        lambda: placed(np.float32), "numpy", files, known.model.licence, about,
    )  # fmt: skip


def _styled(model: Path, config: OnnxConfig) -> _Task:
    known = load_styled_garment(model)
    style = _numbers(config.style)
    worn = known.worn(config.beta, style, AnimateConfig())
    numbers = known.ranges.numbers(style, config.beta)
    weights = known.garment.skin_weights
    assert weights is not None
    rng = np.random.default_rng(0)
    rotations = _probe_rotations(len(known.body.joint_names), config.probes, rng)
    transforms = np.stack([with_pose(worn.person, each, np.zeros(3)).transforms for each in rotations])

    def placed() -> np.ndarray:
        unposed = worn.unposed(rotations)
        return np.stack([skin(each, weights, frame) for each, frame in zip(unposed, transforms, strict=True)])

    about = {
        "rotations": f"joints {', '.join(known.body.joint_names)}, against their parents",
        "transforms": "of the same joints, rest pose to world, metres",
        "vertices": "metres, world; not taken out of the body",
        "style": json.dumps(style),
        "beta": json.dumps([*config.beta]),
    }
    inputs = {"rotations": rotations, "transforms": transforms}
    files = [model / name for name in MODEL_FILES]
    graph = styled_graph(known, worn, numbers)
    return _Task(
        "garment with styles", graph, inputs, "vertices", placed, placed, "torch", files, "none given", about
    )  # fmt: skip


def _numbers(said: Sequence[str]) -> dict[str, float]:
    """NAME=VALUE as numbers by name."""
    found = {}
    for word in said:
        name, _, value = word.partition("=")
        try:
            found[name] = float(value)
        except ValueError:
            raise InputError(f"--style: expected NAME=VALUE, a number, found '{word}'") from None
    return found


# --- probes ------------------------------------------------------------------------------------------------------


def _probe_controls(regressor: Regressor, count: int, rng: np.random.Generator) -> np.ndarray:
    """(n, controls) float32: between learned poses, a few far beyond them, in motion up to twice what was learned."""
    bounded = regressor
    while isinstance(bounded, EnsembleRegressor):
        bounded = bounded.first  # sees what both see
    assert isinstance(bounded, BoundedRegressor)
    known, layout = bounded.controls, bounded.layout
    found = np.repeat(known.mean[None].astype(np.float64), count, axis=0)
    one, other = (known.poses[rng.integers(0, len(known.poses), count)] for _ in range(2))
    reach = np.where(np.arange(count) % 4 == 3, rng.uniform(2, 5, count), rng.uniform(0, 1, count))[:, None]
    found[:, layout.pose_columns] = one + reach * (other - one)
    for (_, part, moves), largest in zip(layout.parts, known.largest, strict=True):
        if moves:
            away = rng.standard_normal((count, part.stop - part.start))
            away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
            found[:, part] += 2 * rng.uniform(size=(count, 1)) * largest * away
    return found.astype(np.float32)


def _probe_rotations(joints: int, count: int, rng: np.random.Generator) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_rotvec(0.3 * rng.standard_normal((count * joints, 3)))
    return turns.as_matrix().reshape(count, joints, 3, 3)


def _probe_transforms(person: ShapedBody, count: int, rng: np.random.Generator) -> np.ndarray:
    rotations = _probe_rotations(len(person.joints), count, rng)
    return np.stack([with_pose(person, each, 0.3 * rng.standard_normal(3)).transforms for each in rotations])


# --- comparing ---------------------------------------------------------------------------------------------------


def _compared(path: Path, task: _Task, probes: int) -> Compared:
    runtime: Any = package_module(ONNX_RUNTIME, "")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])

    def answered() -> np.ndarray:
        return session.run([task.output], dict(task.inputs))[0]

    found, wanted = answered().astype(np.float64), task.ours()
    if found.shape != wanted.shape:
        raise InputError(f"read back: expected {wanted.shape}, found {found.shape}", where=path)
    unit = "deg" if task.output == "high" else "mm"
    away = _angles(found, wanted) if unit == "deg" else 1e3 * np.linalg.norm(found - wanted, axis=-1)
    onnx_ms, ours_ms = (1e3 * _seconds(call) / probes for call in (answered, task.timed))
    return Compared(task.kind, float(away.max()), float(away.mean()), unit, onnx_ms, ours_ms, task.by)


def _angles(found: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Degrees between normals along axis 1; bare places have none. By the chord, which rounding does not blur."""
    shown = np.linalg.norm(wanted, axis=1) > 0.5
    if ((np.linalg.norm(found, axis=1) > 0.5) != shown).any():
        return np.array([180.0])
    chord = np.linalg.norm(found - wanted, axis=1)[shown]
    return np.degrees(2 * np.arcsin(np.minimum(chord / 2, 1)))


def _seconds(call: Callable[[], object]) -> float:
    """CPU seconds of the quickest."""
    found = []
    for _ in range(REPEATS):
        begin = time.process_time()
        call()
        found.append(time.process_time() - begin)
    return min(found)
