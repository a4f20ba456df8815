"""A learned garment, read from WORK/retarget: ready to be moved, and to be worn by somebody else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from capture4d.body.skinning import ShapedBody
from capture4d.captures.animations.config import RemovalConfig
from capture4d.captures.animations.frame_files import FRAMES_AT_ONCE
from capture4d.errors import InputError
from capture4d.files.atomic import read_json
from capture4d.files.reading import reading
from capture4d.files.records import load_body
from capture4d.runs.stage import read_record
from capture4d.types import BlendshapeModel, Body, PoseSequence
from retarget.animation.animator import Animator
from retarget.animation.bodies import captured_person, person_of_shape, require_motion, retargeted_mean
from retarget.config import AnimateConfig
from retarget.model_folder import KERNEL, LINEAR, LSTM, MODEL, POSES, shapes_digest
from retarget.regression.controls import control_vectors
from retarget.regression.ensemble import regressors_by_name
from retarget.regression.kernel import KernelRegressor, load_kernel
from retarget.regression.known_range import KnownRange, load_known_range
from retarget.regression.linear import LinearRegressor, load_linear
from retarget.regression.regressors import Regressor
from retarget.shapes.files import load_blendshapes

__all__ = ["GarmentModel", "load_garment_model"]


@dataclass(frozen=True, slots=True, eq=False)
class GarmentModel:
    """A learned garment, ready to be moved.

    garment = load_garment_model(Path("WORK"))
    vertices = garment.vertices(poses)
    """

    folder: Path
    model: BlendshapeModel
    body: Body
    linear: LinearRegressor
    kernel: KernelRegressor | None
    lstm: Regressor | None
    limits: KnownRange
    validated: Mapping[str, float]
    """Vertex errors of the regressors on the frames that validated, mm."""
    digest: str
    """Of the blendshapes' file."""

    @property
    def regressors(self) -> dict[str, Regressor]:
        """Those that the model has, by name. Far from what they were taught they fade towards the template."""
        return regressors_by_name(self.limits, self.linear, self.lstm, self.kernel)

    @property
    def best_name(self) -> str:
        """The regressor that did best on the frames that validated; without such frames, the last there is."""
        found = list(self.regressors)
        errors = {name: self.validated[name] for name in found if name in self.validated}
        return min(errors, key=lambda name: errors[name]) if len(errors) == len(found) else found[-1]

    @property
    def best(self) -> Regressor:
        return self.regressors[self.best_name]

    def person(self, beta: Sequence[float] | Float[np.ndarray, " betas"] | None = None) -> ShapedBody:
        """Somebody with the model's body.

        Args:
            beta: shape coefficients, of which the last may be left out; None: whom the garment was learned on.
        """
        return captured_person(self.model, self.body) if beta is None else person_of_shape(self.model, self.body, beta)

    def vertices(
        self,
        pose: PoseSequence,
        beta: Sequence[float] | Float[np.ndarray, " betas"] | None = None,
        *,
        remove_intersections: bool = True,
    ) -> Float32[np.ndarray, "frames verts 3"]:
        """The garment on a person in motion, as `capture4d animate` writes it: metres, world, a row for each pose.

        Args:
            pose: a motion at the model's frame rate, such as `read_motion(path, garment.body, fps=garment.model.fps)`;
                the garment sways with what went before, so give the motion whole.
            beta: shape coefficients of the person, of which the last may be left out; None: whom the garment was
                learned on.
            remove_intersections: move what is inside the body out of it.
        Raises:
            InputError: the poses are of another skeleton or frame rate, or in disorder; or numbers are not finite.
        """
        try:
            require_motion(self.model, pose)
        except InputError as error:
            raise error.at("pose") from None
        person, regressor = self.person(beta), self.best
        config = AnimateConfig(removal=RemovalConfig(enabled=remove_intersections))
        motion = replace(pose, shape=np.asarray(person.shape, np.float32))
        mean = retargeted_mean(self.model, captured_person(self.model, self.body), person, formula=config.mean)
        animator = Animator(self.model, person, mean, config)
        coefficients = regressor.predict(control_vectors(regressor.layout, motion))
        count = len(motion.frame_ids)
        chunks = [range(start, min(start + FRAMES_AT_ONCE, count)) for start in range(0, count, FRAMES_AT_ONCE)]
        return np.stack([each.vertices for rows in chunks for each in animator.frames(motion, coefficients, rows)])


def load_garment_model(path: str | Path, *, device: str = "cpu", with_lstm: bool = True) -> GarmentModel:
    """Read what `fit` wrote.

    Args:
        path: WORK/retarget, WORK, or the blendshapes.safetensors in it.
        device: where torch computes.
        with_lstm: read the LSTM too, if there is one; it takes a second, for it needs torch.
    Raises:
        InputError: a file is missing, damaged, or belongs to another model.
    """
    folder = _model_folder(Path(path))
    model, digest = load_blendshapes(folder / MODEL), shapes_digest(folder)
    linear = load_linear(folder / LINEAR, model_digest=digest)
    _require_shapes(folder / LINEAR, model, len(linear.intercept))
    kernel = lstm = None
    if (folder / KERNEL).is_file():
        kernel = load_kernel(folder / KERNEL, model_digest=digest)
        _require_shapes(folder / KERNEL, model, len(kernel.middle))
    if with_lstm and (folder / LSTM).is_file():
        from retarget.regression.lstm import load_lstm

        lstm = load_lstm(folder / LSTM, model_digest=digest, linear=linear, device=device)
    known = load_known_range(folder / POSES, model_digest=digest)
    with reading(folder / POSES, "known range"):
        for name, each in (("linear", linear), ("kernel", kernel)):
            if each is not None:
                known.require(name, each.layout, len(model.std))
    body, validated = load_body(folder / "body.npz"), _validated(folder)
    return GarmentModel(folder, model, body, linear, kernel, lstm, known, validated, digest)


def _validated(folder: Path) -> dict[str, float]:
    """Vertex errors of the regressors on the frames that validated, mm, as far as fit.json tells."""
    path = folder / "fit.json"
    note = read_json(path) if path.is_file() else {}
    errors = {name: note.get(name, {}).get("validation") for name in ("linear", "lstm", "kernel", "ensemble")}
    return {name: float(each["vertex_error_mm"]) for name, each in errors.items() if each}


def _model_folder(path: Path) -> Path:
    """The folder of a finished model."""
    folder = path.parent if path.is_file() else path / "retarget" if (path / "retarget").is_dir() else path
    if path.is_file() and path.name != MODEL:
        raise InputError(f"expected {MODEL} or the folder that holds it, found another file", where=path)
    if not (folder / MODEL).is_file():
        raise InputError(f"expected a model ({MODEL}), found none; run: capture4d fit WORK", where=folder)
    record = read_record(folder / "stage.json") if (folder / "stage.json").is_file() else {}
    if record.get("status", "complete") != "complete":
        raise InputError("'fit' is not finished; run its command again", where=folder)
    return folder


def _require_shapes(path: Path, model: BlendshapeModel, found: int) -> None:
    if found != len(model.std):
        raise InputError(f"expected {len(model.std)} coefficients, found {found}", where=path)
