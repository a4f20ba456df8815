"""What `capture4d texture`, `export` and `export-onnx` do, for Python: the pipeline hands them on."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from capture4d.app.cards.sources import with_card
from capture4d.app.export.config import ExportConfig, Format
from capture4d.app.onnx_models.config import OnnxConfig
from capture4d.captures.work_folder import AnyWork, Place, opened_work
from capture4d.runs.run_log import logged_stage
from capture4d.runs.stage import StageResult
from capture4d.texturing.config import TextureConfig

if TYPE_CHECKING:
    from capture4d.app.export.stage import Exported
    from capture4d.app.onnx_models.stage import Compared

__all__ = ["export", "export_onnx", "texture"]


@logged_stage("texture")
def texture(
    work: AnyWork, config: TextureConfig | None = None, *, workers: int = 1, overwrite: bool = False
) -> StageResult:
    """Bake the colours of a registered take's scans to its template's UVs, without the light on them: WORK/texture."""
    from capture4d.texturing.stage import run as stage

    return stage(opened_work(work), config or TextureConfig(), workers=workers, overwrite=overwrite)


@logged_stage("export")
def export(
    work: AnyWork,
    formats: Sequence[Format],
    output: Place | None = None,
    config: ExportConfig | None = None,
    *,
    frames: str = "",
    overwrite: bool = False,
) -> Exported:
    """Hand a registered or animated garment on to other tools: a file for each format, each read back.

    Args:
        formats: of "usd", "abc", "glb", "pc2", "mdd", "obj", "ply", "html".
        output: folder to write; WORK/exports if None.
        frames: only these, such as "1-200:5".
    """
    from capture4d.app.export.stage import run as stage

    opened = opened_work(work)
    folder = opened.path / "exports" if output is None else Path(output)
    done = stage(opened, folder, formats, config or ExportConfig(), frames=frames, overwrite=overwrite)
    with_card(done.result)
    return done


@logged_stage("export-onnx")
def export_onnx(
    model: Place, output: Place | None = None, config: OnnxConfig | None = None, *, overwrite: bool = False
) -> tuple[StageResult, Compared]:
    """Write a learned garment or a wrinkle network as an ONNX file, and compare it with the model.

    Args:
        model: what `fit`, `fit_styles` or `wrinkles_train` wrote.
        output: folder to write; MODEL/onnx if None.
    """
    from capture4d.app.onnx_models.stage import run as stage

    folder = Path(model) / "onnx" if output is None else Path(output)
    done, compared = stage(Path(model), folder, config or OnnxConfig(), overwrite=overwrite)
    return with_card(done), compared
