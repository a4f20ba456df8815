"""The stage that learns a garment with styles: a style set in, MODEL out.

stage.json            what was run
garment.npz body.npz styles.safetensors   the model, `retarget.mixture.model_files`
errors.json           how it was learned, and its errors on pairs and poses that were learned from or not
metrics.jsonl         loss and validation error of every epoch of every network
checkpoints/          of each network while it is trained; gone when the model is there
"""

from __future__ import annotations

import math
import shutil
from dataclasses import asdict
from pathlib import Path

from capture4d.captures.drapes.style_sets import read_style_set
from capture4d.files.atomic import nan_to_none, write_json, write_json_lines
from capture4d.runs.stage import StageResult, open_stage
from retarget.mixture.config import StylesConfig
from retarget.mixture.evaluation import measure, unposed_by
from retarget.mixture.learning import learn_styles
from retarget.mixture.lesson import style_lesson
from retarget.mixture.model_files import MODEL_FILES, save_styled_garment

__all__ = ["run"]

SCHEMA = 1
FILES = (*MODEL_FILES, "errors.json")


def run(styles: Path, output: Path, config: StylesConfig, *, workers: int = 1, overwrite: bool = False) -> StageResult:
    """Learn a garment from a style set, unless that has been done.

    Args:
        styles: what `synth-drapes --preset` wrote.
        output: folder to write.
        workers: torch's threads.
    Raises:
        InputError: the style set is missing, unfinished or damaged, or has nothing to learn from.
    """
    source = read_style_set(styles)
    stage = open_stage(
        output, name="fit-styles", schema=SCHEMA, config=config, upstream={"styles": source.digest},
        sources={"styles": styles}, overwrite=overwrite,
    )  # fmt: skip
    paths = [output / name for name in FILES]
    if stage.was_complete and all(path.is_file() for path in paths):
        return stage.finish(paths, changed=False)
    lesson = style_lesson(source)
    garment, note, history = learn_styles(lesson, config, output / "checkpoints", threads=workers)
    save_styled_garment(output, garment)
    errors = {part: nan_to_none(asdict(found)) for part, found in measure(lesson, unposed_by(garment)).items()}
    write_json(output / "errors.json", {"learned": note, "errors": errors})
    write_json_lines(output / "metrics.jsonl", [row for row in history if math.isfinite(row["loss"])])
    shutil.rmtree(output / "checkpoints", ignore_errors=True)
    return stage.finish(paths)
