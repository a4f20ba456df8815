"""Captures and drapes that nobody filmed, what drapes teach, and offset images, as functions by the names of their
commands; `capture4d.pipeline` hands them on."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from capture4d.app.cards.sources import with_card
from capture4d.captures.work_folder import AnyWork, opened_work
from capture4d.errors import InputError
from capture4d.runs.run_log import logged_stage
from capture4d.runs.stage import StageResult
from data_synth.config import PRESETS, TRAINING_SETS, BoardConfig, SynthConfig, TrainingSetConfig
from data_synth.drapes.config import DrapesConfig
from data_synth.scanner.config import ScanConfig
from data_synth.styles.config import STYLE_SETS, StyleSetConfig
from retarget.mixture.config import StyleFitConfig, StylesConfig
from wrinkles.offset_images.config import DrapeOffsetsConfig, OffsetConfig, PredictOffsetsConfig, RemovalConfig
from wrinkles.offset_images.editing.config import DrawConfig

if TYPE_CHECKING:
    from retarget.mixture.style_of_work import StyleFound
    from wrinkles.offset_images.editing.stage import Edited

__all__ = [
    "fit_style", "fit_styles", "offsets_apply", "offsets_draw", "offsets_edit", "offsets_predict", "offsets_train",
    "scan", "synth", "synth_board", "synth_drapes", "wrinkles_offsets",
]  # fmt: skip

Place: TypeAlias = str | Path


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

    if isinstance(config, str):
        known: dict[str, SynthConfig | TrainingSetConfig] = {**PRESETS, **TRAINING_SETS}
        if config not in known:
            raise InputError(f"config: expected one of {', '.join(known)}, found '{config}'")
        config = known[config]
    if isinstance(config, SynthConfig):
        return stage(Path(output), config, workers=workers, overwrite=overwrite)
    return training_set(Path(output), config, workers=workers, overwrite=overwrite)


@logged_stage("wrinkles offsets")
def wrinkles_offsets(
    work: AnyWork, config: OffsetConfig | None = None, *, workers: int = 1, overwrite: bool = False
) -> StageResult:
    """Learn offset images of a registered take from its poses, and a baseline: WORK/wrinkles/offsets."""
    from wrinkles.offset_images.model_files import OFFSETS
    from wrinkles.offset_images.stage import run as stage

    opened = opened_work(work)
    return stage(opened, opened.path / OFFSETS, config or OffsetConfig(), workers=workers, overwrite=overwrite)


@logged_stage("offsets train")
def offsets_train(
    drapes: Place,
    output: Place,
    config: DrapeOffsetsConfig | None = None,
    *,
    labels: Place | None = None,
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Learn a garment's offsets from the body from a set of drapes.

    Args:
        drapes: what `synth_drapes` wrote of one style on one person.
        labels: a .npy with a whole number for each face of the garment: the patch it belongs to.
        workers: torch's threads; the last bits of a network depend on their number.
    """
    from wrinkles.offset_images.train_stage import run as stage

    given = None if labels is None else Path(labels)
    config = config or DrapeOffsetsConfig()
    return with_card(stage(Path(drapes), Path(output), config, labels=given, workers=workers, overwrite=overwrite))


@logged_stage("offsets predict")
def offsets_predict(
    model: Place,
    poses: Place,
    output: Place,
    config: PredictOffsetsConfig | None = None,
    *,
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Put what `offsets_train` learned on a motion, out of the body: OUTPUT/body and OUTPUT/registration, as `animate`
    writes them."""
    from wrinkles.offset_images.predict_stage import run as stage

    config = config or PredictOffsetsConfig()
    return stage(Path(model), Path(poses), Path(output), config, workers=workers, overwrite=overwrite)


def offsets_draw(
    work: AnyWork, frame_id: int, output: Place, config: DrawConfig | None = None, *, overwrite: bool = False
) -> Path:
    """Draw a registered frame as two pictures of offsets from the body, front and back; the folder they are in.

    Args:
        overwrite: put them also over files that hold something else.
    Raises:
        InputError: there is no such frame, or the template is not bound to the body that moved it.
    """
    from capture4d.files.outputs import new_files_in
    from wrinkles.offset_images.editing.stage import draw

    with new_files_in(Path(output), overwrite=overwrite) as workshop:
        draw(opened_work(work), frame_id, workshop, config or DrawConfig())
    return Path(output)


def offsets_edit(pictures: Place, operations: Place, work: AnyWork, output: Place, *, overwrite: bool = False) -> Path:
    """Change drawn pictures by the operations of a JSON file: shift, inflate, paint, transfer; the folder of the new
    ones.

    Args:
        pictures: folder of `offsets_draw`, or of this function; it stays as it is.
        work: what the pictures were drawn of.
    Raises:
        InputError: an operation is unknown, or a folder is damaged or of another take or size.
    """
    from capture4d.files.outputs import new_files_in
    from wrinkles.offset_images.editing.stage import edit

    drawn, told = Path(pictures), Path(operations)
    inputs = [path for path in sorted(drawn.glob("*")) if path.is_file()]
    with new_files_in(Path(output), inputs=[told, *inputs], overwrite=overwrite) as workshop:
        edit(drawn, told, opened_work(work), workshop)
    return Path(output)


def offsets_apply(
    pictures: Place, work: AnyWork, output: Place, config: RemovalConfig | None = None, *, overwrite: bool = False
) -> Edited:
    """Write the garment that changed pictures show, taken out of the body; where nothing changed it stays as it was.

    Args:
        pictures: folder of `offsets_draw` or `offsets_edit`, its pictures changed by whatever program.
        output: mesh to write: ply, obj, glb or off.
    Raises:
        InputError: the folder is damaged, or of another registration.
    """
    from capture4d.files.outputs import new_files
    from capture4d.mesh_files.meshes import write_mesh
    from wrinkles.offset_images.editing.stage import apply

    drawn, mesh = Path(pictures), Path(output)
    inputs = [path for path in sorted(drawn.glob("*")) if path.is_file()]
    with new_files([mesh], inputs=inputs, overwrite=overwrite) as workshop:
        edited = apply(drawn, opened_work(work), config or RemovalConfig())
        write_mesh(workshop / mesh.name, edited.mesh)
    return edited


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

    if isinstance(config, str):
        if config not in STYLE_SETS:
            raise InputError(f"config: expected one of {', '.join(STYLE_SETS)}, found '{config}'")
        config = STYLE_SETS[config]
    if isinstance(config, StyleSetConfig):
        return style_set(Path(output), config, workers=workers, overwrite=overwrite)

    result = stage(Path(output), config or DrapesConfig(), workers=workers, overwrite=overwrite)
    write_page(result.path)
    return result


@logged_stage("fit-styles")
def fit_styles(
    styles: Place,
    output: Place,
    config: StylesConfig | None = None,
    *,
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Learn a garment in all its styles from a style set: a function of pose, shape and style.

    Args:
        styles: what `synth_drapes` wrote of a style set.
        workers: torch's threads; the last bits of a network depend on their number.
    """
    from retarget.mixture.stage import run as stage

    return with_card(stage(Path(styles), Path(output), config or StylesConfig(), workers=workers, overwrite=overwrite))


def fit_style(
    model: Place,
    work: Place,
    output: Place,
    config: StyleFitConfig | None = None,
    *,
    overwrite: bool = False,
) -> StyleFound:
    """Find the style and the person of a garment that was registered or scanned; writes style.json.

    Args:
        model: what `fit_styles` wrote.
        work: of a take on the model's body, registered, or extracted and tracked.
        output: style.json; `.fit.style` of what is returned says the same.
        overwrite: also over a file that holds something else.
    Raises:
        InputError: nothing was seen there, or on another body.
    """
    from retarget.mixture.style_of_work import run as stage

    return stage(Path(model), Path(work), Path(output), config or StyleFitConfig(), overwrite=overwrite)
