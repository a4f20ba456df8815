"""Captures that nobody filmed, and drapes."""

from __future__ import annotations

from pathlib import Path

from capture4d.captures.work_folder import Place
from capture4d.runs.run_log import logged_stage
from capture4d.runs.stage import StageResult
from capture4d.steps.presets import chosen
from data_synth.config import PRESETS, TRAINING_SETS, BoardConfig, SynthConfig, TrainingSetConfig
from data_synth.drapes.config import DrapesConfig
from data_synth.scanner.config import ScanConfig
from data_synth.styles.config import STYLE_SETS, StyleSetConfig

__all__ = [
    "scan", "synth", "synth_board", "synth_drapes",
]  # fmt: skip


@logged_stage("synth")
def synth(
    output: Place, config: SynthConfig | TrainingSetConfig | str = "demo", *, workers: int = 1, overwrite: bool = False
) -> StageResult:
    """Simulate a garment on a moving body and scan it: a capture folder with its exact truth.

    Args:
        config: name of a preset, such as "tiny" or "tshirt-200k", or of a training set, which is many takes; or the
            settings themselves.
    Raises:
        InputError: there is no such preset, or the folder holds something else.
    """
    from data_synth.stage import run as stage
    from data_synth.training_set import run as training_set

    known: dict[str, SynthConfig | TrainingSetConfig] = {**PRESETS, **TRAINING_SETS}
    config = chosen(config, known)
    if isinstance(config, SynthConfig):
        return stage(Path(output), config, workers=workers, overwrite=overwrite)
    return training_set(Path(output), config, workers=workers, overwrite=overwrite)


@logged_stage("scan")
def scan(
    meshes: Place,
    output: Place,
    config: ScanConfig | None = None,
    *,
    template: Place | None = None,
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Scan a mesh sequence with the virtual camera rig: a capture folder, with truth if the faces stay.

    Args:
        template: mesh to register later: lies on the first mesh, or is the same mesh in another pose.
    """
    from data_synth.scan_stage import run as stage

    given = None if template is None else Path(template)
    config = config or ScanConfig()
    return stage(Path(meshes), Path(output), config, template=given, workers=workers, overwrite=overwrite)


@logged_stage("synth-board")
def synth_board(
    rig: Place, images: Place, config: BoardConfig | None = None, *, workers: int = 1, overwrite: bool = False
) -> StageResult:
    """Photograph a calibration board with a virtual rig: IMAGES/CAMERA/POSE.png."""
    from data_synth.board.stage import run as stage

    return stage(Path(rig), Path(images), config or BoardConfig(), workers=workers, overwrite=overwrite)


@logged_stage("synth-drapes")
def synth_drapes(
    output: Place,
    config: DrapesConfig | StyleSetConfig | str | None = None,
    *,
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Drape a garment over a still body in many poses, to learn from; `failed` are the drapes that are not fit for it.

    `report.html` in the folder of one person and style draws what pruning costs, and where cloth is stretched, crushed
    or runs through itself.

    Args:
        config: of one style on one person; or name or settings of a style set, such as "tiny-styles".

    Raises:
        InputError: the style, the shape or the preset is none, or the folder holds something else.
    """
    from capture4d.app.report.drapes import write_page
    from data_synth.drapes.stage import run as stage
    from data_synth.styles.stage import run as style_set

    known: dict[str, DrapesConfig | StyleSetConfig] = {**STYLE_SETS}
    config = chosen(config or DrapesConfig(), known)
    if isinstance(config, StyleSetConfig):
        return style_set(Path(output), config, workers=workers, overwrite=overwrite)

    result = stage(Path(output), config, workers=workers, overwrite=overwrite)
    write_page(result.path)
    return result
