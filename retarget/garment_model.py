"""A learned garment as it lies in WORK/retarget, ready to be moved."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from capture4d.errors import InputError
from capture4d.files.atomic import file_digest, read_json
from capture4d.files.records import load_body
from capture4d.types import BlendshapeModel, Body
from retarget.regression.ensemble import ensemble
from retarget.regression.kernel import KernelRegressor, load_kernel
from retarget.regression.linear import LinearRegressor, load_linear
from retarget.regression.pose_range import PoseRange, load_pose_range
from retarget.regression.regressors import Regressor
from retarget.regression.splits import Piece
from retarget.shapes.files import load_blendshapes

__all__ = [
    "KERNEL",
    "LINEAR",
    "LSTM",
    "MODEL",
    "POSES",
    "GarmentModel",
    "learned_frames",
    "load_garment_model",
    "model_digest_of",
    "piece_name",
    "regressor_files",
    "regressors_by_name",
]

MODEL, LINEAR, KERNEL, LSTM, POSES = (
    f"{name}.safetensors" for name in ("blendshapes", "linear", "kernel", "lstm", "poses")
)


_PIECE = re.compile(r"(.*)\[(\d+):(\d+)\]")


def piece_name(names: Sequence[str], piece: Piece) -> str:
    return f"{names[piece.take]}[{piece.frames.start}:{piece.frames.stop}]"


def learned_frames(folder: Path, registration: str) -> list[range]:
    """The frames, as positions in its take, that a model's shapes or regressors were learned from.

    The end of an only take validates and is not learned from; whole clips that validate are, once they have chosen.

    Args:
        folder: what `run` wrote.
        registration: digest of the take's registration.
    Raises:
        InputError: files of the model are missing or damaged.
    """
    taken = read_json(folder / "stage.json").get("upstream", {})
    names = [name for name, digest in taken.items() if digest == registration]
    try:
        split = read_json(folder / "fit.json")["split"]
        pieces = {role: [_PIECE.fullmatch(piece) for piece in split[role]] for role in ("training", "validation")}
    except (KeyError, TypeError):
        raise InputError(f"{folder / 'fit.json'}: expected the split of the takes, found none") from None

    def frames(role: str) -> list[range]:
        return [range(int(piece[2]), int(piece[3])) for piece in pieces[role] if piece and piece[1] in names]

    return frames("training") or frames("validation")


def model_digest_of(folder: Path) -> str:
    return file_digest([folder / MODEL], root=folder)


@dataclass(frozen=True, slots=True, eq=False)
class GarmentModel:
    """A learned garment, ready to be moved."""

    folder: Path
    model: BlendshapeModel
    body: Body
    linear: LinearRegressor
    kernel: KernelRegressor | None
    lstm: Regressor | None
    poses: PoseRange
    digest: str
    """Of the blendshapes' file."""

    @property
    def regressors(self) -> dict[str, Regressor]:
        """Those that the model has, by name; the best last."""
        return regressors_by_name(self.linear, self.lstm, self.kernel)

    @property
    def best(self) -> Regressor:
        return list(self.regressors.values())[-1]


def regressors_by_name(
    linear: LinearRegressor, lstm: Regressor | None, kernel: KernelRegressor | None
) -> dict[str, Regressor]:
    """The regressors that there are; the best last."""
    both = None if lstm is None or kernel is None else ensemble(kernel, lstm)
    found = {"linear": linear, "lstm": lstm, "kernel": kernel, "ensemble": both}
    return {name: each for name, each in found.items() if each is not None}


def regressor_files(folder: Path, name: str) -> list[Path]:
    """What a regressor of a model consists of."""
    files = {"ensemble": (LINEAR, LSTM, KERNEL), "kernel": (KERNEL,), "lstm": (LINEAR, LSTM), "linear": (LINEAR,)}
    return [folder / file for file in files[name]]


def load_garment_model(path: Path, *, device: str = "cpu", with_lstm: bool = True) -> GarmentModel:
    """Read what `run` wrote.

    Args:
        path: WORK/retarget, WORK, or the blendshapes.safetensors in it.
    Raises:
        InputError: a file is missing, damaged, or belongs to another model.
    """
    folder = path.parent if path.is_file() else path / "retarget" if (path / "retarget").is_dir() else path
    if path.is_file() and path.name != MODEL:
        raise InputError(f"{path}: expected {MODEL} or the folder that holds it, found another file")
    if not (folder / MODEL).is_file():
        raise InputError(f"{folder}: expected a model ({MODEL}), found none; run: capture4d fit WORK")
    record = read_json(folder / "stage.json") if (folder / "stage.json").is_file() else {}
    if record.get("status", "complete") != "complete":
        raise InputError(f"{folder}: 'fit' is not finished; run its command again")
    model = load_blendshapes(folder / MODEL)
    digest = model_digest_of(folder)
    linear = load_linear(folder / LINEAR, model_digest=digest)
    if len(linear.intercept) != len(model.std):
        raise InputError(f"{folder / LINEAR}: expected {len(model.std)} coefficients, found {len(linear.intercept)}")
    kernel = None
    if (folder / KERNEL).is_file():
        kernel = load_kernel(folder / KERNEL, model_digest=digest)
        if len(kernel.middle) != len(model.std):
            raise InputError(f"{folder / KERNEL}: expected {len(model.std)} coefficients, found {len(kernel.middle)}")
    lstm = None
    if with_lstm and (folder / LSTM).is_file():
        from retarget.regression.lstm import load_lstm

        lstm = load_lstm(folder / LSTM, model_digest=digest, linear=linear, device=device)
    known = load_pose_range(folder / POSES, model_digest=digest)
    return GarmentModel(folder, model, load_body(folder / "body.npz"), linear, kernel, lstm, known, digest)
