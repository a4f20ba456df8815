"""Pixel-based cloth, beside the wrinkles and on its own."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from capture4d.app.cards.sources import with_card
from capture4d.captures.animations.config import RemovalConfig
from capture4d.captures.work_folder import AnyWork, Place, opened_work
from capture4d.runs.run_log import logged_stage
from capture4d.runs.stage import StageResult
from capture4d.steps.presets import chosen
from wrinkles.offset_images import config as offset_config
from wrinkles.offset_images.config import DrapeOffsetsConfig, OffsetConfig, PredictOffsetsConfig
from wrinkles.offset_images.editing.config import DrawConfig

if TYPE_CHECKING:
    from wrinkles.offset_images.editing.stage import Edited

__all__ = [
    "offsets_apply", "offsets_draw", "offsets_edit", "offsets_predict", "offsets_train", "wrinkles_offsets",
]  # fmt: skip


@logged_stage("wrinkles offsets")
def wrinkles_offsets(
    work: AnyWork, config: OffsetConfig | None = None, *, workers: int = 1, overwrite: bool = False
) -> StageResult:
    """Learn offset images of a registered take from its poses, and baselines: WORK/wrinkles/offsets."""
    from wrinkles.offset_images.model_files import OFFSETS
    from wrinkles.offset_images.stage import run as stage

    opened = opened_work(work)
    return stage(opened, opened.path / OFFSETS, config or OffsetConfig(), workers=workers, overwrite=overwrite)


@logged_stage("offsets train")
def offsets_train(
    drapes: Place,
    output: Place,
    config: DrapeOffsetsConfig | str | None = None,
    *,
    labels: Place | None = None,
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Learn a garment's offsets from the body from a set of drapes.

    Args:
        drapes: what `synth_drapes` wrote of one style on one person.
        config: settings, or the name of a preset.
        labels: a .npy with a whole number for each face of the garment: the patch it belongs to.
        workers: torch's threads; the last bits of a network depend on their number.
    """
    from wrinkles.offset_images.train_stage import run as stage

    given = None if labels is None else Path(labels)
    settings = chosen(config, offset_config.PRESETS)
    return with_card(stage(Path(drapes), Path(output), settings, labels=given, workers=workers, overwrite=overwrite))


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
