"""The print of a take's cloth as a file of the registration stage, print.npz: made before the frames, and kept.

It is made from the template, the settings, and the garments and poses of the frames that it is learned from, or from a
picture. Frames are made anew where it comes out otherwise. Of plain cloth the file says that it is plain.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from capture4d.captures.garment_scans import load_garment_scan
from capture4d.errors import InputError
from capture4d.files.atomic import file_digest
from capture4d.files.pictures import read_picture
from capture4d.runs.changes import say
from capture4d.runs.frame_lists import frame_file
from capture4d.runs.growing import GrowingStage
from capture4d.runs.made import Ledger, digest_of
from registration.cloth_colours import ClothColours
from registration.config import ColourConfig, RegistrationConfig
from registration.predictions import Mover
from registration.prints import learn_print, learning_positions, print_of_picture, save_print
from registration.template import TemplateAnalysis

__all__ = ["PRINT", "made_print", "print_inputs", "settings_with_print"]

PRINT = "print.npz"


def print_inputs(
    config: ColourConfig, settings: str, garments: Sequence[str], poses: Sequence[str], fps: float
) -> dict[str, str]:
    """What a take's print is made from.

    Args:
        settings: digest of what all frames share.
        garments, poses: digests of each frame's.
    Raises:
        InputError: there is no such picture.
    """
    if config.print is not None:
        path = Path(config.print)
        if not path.is_file():
            raise InputError("no such picture of the print", where=path)
        return {"settings": settings, "picture": file_digest([path], root=path.parent)}
    frames = [[garments[position], poses[position]] for position in learning_positions(len(garments), fps)]
    return {"settings": settings, "frames": digest_of(frames)}


def settings_with_print(settings: str, ledger: Ledger) -> str:
    """Digest of what all frames share, with the print that was made."""
    made = ledger.of(ledger.folder / PRINT)
    return settings if made is None or not made.said.get("printed") else digest_of([settings, made.digest])


def made_print(
    stage: GrowingStage,
    inputs: dict[str, str],
    garments: Path,
    frames: tuple[Sequence[int], float],
    config: RegistrationConfig,
    opened: Callable[[], tuple[TemplateAnalysis, Mover | None]],
) -> list[Path]:
    """Make the print of a take unless it stands; its file, none where the cloth is plain.

    Args:
        garments: folder of the garment scans.
        frames: numbers of the take's, and how many there are a second.
        opened: the template, and what moves it; asked for only where there is something to make.
    """
    path, (frame_ids, fps) = stage.path / PRINT, frames
    made = stage.ledger.of(path)
    if made is None or not stage.stands(path, inputs):
        begin, (analysis, mover) = time.process_time(), opened()
        cloth: tuple[ClothColours, ...]
        if config.colour.print is not None:
            cloth, contrast = print_of_picture(analysis, read_picture(Path(config.colour.print))), np.nan
            say(f"{stage.path.name}: the print is that of {config.colour.print}")
        else:
            cloth, contrast = learn_print(
                analysis, mover, learning_positions(len(frame_ids), fps), frame_ids, config=config,
                load=lambda frame_id: load_garment_scan(frame_file(garments, frame_id), frame_id),
            )  # fmt: skip
            _say_print(stage, bool(cloth), contrast)
        told = {"printed": bool(cloth), "cpu_s": round(time.process_time() - begin, 2)}
        made = stage.make(path, lambda: save_print(path, cloth, contrast), inputs=inputs, said=told)
    return [path] if made.said.get("printed") else []


def _say_print(stage: GrowingStage, printed: bool, contrast: float) -> None:
    if printed:
        say(f"{stage.path.name}: the cloth is printed (contrast {contrast:.2f}), and its colours take part")
    elif np.isnan(contrast):
        say(f"{stage.path.name}: the garments have no colours, as an earlier version extracted them; none take part")
    else:
        say(f"{stage.path.name}: the cloth is plain (contrast {contrast:.2f}), and its colours take no part")
