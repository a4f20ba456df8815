"""What `capture4d import` and `score` do, for Python: the pipeline hands them on."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from capture4d.app.importing.config import ImportConfig
from capture4d.captures.work_folder import AnyCapture, AnyWork, Place, opened_capture, opened_work
from capture4d.runs.run_log import logged_stage
from capture4d.runs.stage import StageResult

if TYPE_CHECKING:
    from capture4d.app.importing.score import Score

__all__ = ["import_meshes", "score"]


@logged_stage("import")
def import_meshes(
    meshes: Place, template: Place, work: Place, config: ImportConfig | None = None, *, overwrite: bool = False
) -> StageResult:
    """Bring a sequence that another tool registered or edited into a work folder: WORK/registration.

    Args:
        meshes: a folder with a mesh file a frame, or a USD, Alembic, GLB, PC2 or MDD file.
        template: the mesh that moves, a template.npz or a mesh file, in the same order of vertices.
    """
    from capture4d.app.importing.stage import run as stage

    folder = Path(work) / "registration"
    return stage(Path(meshes), Path(template), folder, config or ImportConfig(), overwrite=overwrite)


def score(work: AnyWork, capture: AnyCapture, *, workers: int = 1) -> Score:
    """Measure a registered sequence against the truth of a synthetic take: WORK/score.json.

    Args:
        capture: with truth/, of the same template.
    """
    from capture4d.app.importing.score import run

    return run(opened_work(work), opened_capture(capture), workers=workers)
