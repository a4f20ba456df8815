"""What lies in WORK/retarget: the files of a learned garment, and which frames it was learned from."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from capture4d.errors import InputError
from capture4d.files.atomic import file_digest, read_json
from capture4d.runs.stage import read_record
from retarget.regression.splits import Piece

__all__ = [
    "KERNEL",
    "LINEAR",
    "LSTM",
    "MODEL",
    "POSES",
    "learned_frames",
    "piece_name",
    "regressor_files",
    "shapes_digest",
]

MODEL, LINEAR, KERNEL, LSTM, POSES = (
    f"{name}.safetensors" for name in ("blendshapes", "linear", "kernel", "lstm", "poses")
)

_PIECE = re.compile(r"(.*)\[(\d+):(\d+)\]")


def piece_name(names: Sequence[str], piece: Piece) -> str:
    """A piece as fit.json has it.

    Args:
        names: of the takes.
    """
    return f"{names[piece.take]}[{piece.frames.start}:{piece.frames.stop}]"


def learned_frames(folder: Path, registration: str) -> list[range]:
    """The frames, as positions in its take, that a model's shapes or regressors were learned from.

    The end of an only take validates and is not learned from; whole clips that validate are, once they have chosen.

    Args:
        folder: what `fit` wrote.
        registration: digest of the take's registration.
    Raises:
        InputError: files of the model are missing or damaged.
    """
    taken = read_record(folder / "stage.json").get("upstream", {})
    names = [name for name, digest in taken.items() if digest == registration]
    try:
        split = read_json(folder / "fit.json")["split"]
        pieces = {role: [_PIECE.fullmatch(piece) for piece in split[role]] for role in ("training", "validation")}
    except (KeyError, TypeError):
        raise InputError("expected the split of the takes, found none", where=folder / "fit.json") from None

    def frames(role: str) -> list[range]:
        return [range(int(piece[2]), int(piece[3])) for piece in pieces[role] if piece and piece[1] in names]

    return frames("training") or frames("validation")


def shapes_digest(folder: Path) -> str:
    """Of the blendshapes' file; regressors note it, so that they are not used with others."""
    return file_digest([folder / MODEL], root=folder)


def regressor_files(folder: Path, name: str) -> list[Path]:
    """What a regressor of a model consists of."""
    files = {"ensemble": (LINEAR, LSTM, KERNEL), "kernel": (KERNEL,), "lstm": (LINEAR, LSTM), "linear": (LINEAR,)}
    return [folder / file for file in files[name]]
