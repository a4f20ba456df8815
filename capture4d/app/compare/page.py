"""One page that compares what gives a garment its surface, on the same held-out frames: WORK/compare/index.html.

compare.json holds the table and names the pictures, which pictures/ keeps for the report. Nothing is learned here.

registration        the template as registered, without a map
blendshapes         the registration, projected on a learned garment's principal directions
regression          the learned garment from the poses alone: linear, by the LSTM, by kernels, by both of these
network             the registration with maps made by a trained generator
offset images       vertices decoded from an image that a network predicts from the pose alone, whole or in patches
fully connected     the same with a fully connected network, to all offsets or to principal components

docs/methods/wrinkles.md defines the measures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

from capture4d.app.compare.config import CompareConfig
from capture4d.app.compare.inputs import open_inputs
from capture4d.app.compare.measures import Row, conclusion, measure, true_vertices
from capture4d.app.compare.methods import methods
from capture4d.app.compare.pictures import Pictures, draw
from capture4d.app.compare.table import LEARNED, comparison_table
from capture4d.app.drawing.page import render_page
from capture4d.app.drawing.panels import Panel, write_panel
from capture4d.captures.truth import read_truth_model
from capture4d.captures.work_folder import WorkFolder
from capture4d.files.atomic import write_bytes, write_json
from capture4d.runs.stage import Stage, StageResult, open_stage

__all__ = ["run"]

SCHEMA = 6


def run(
    work: WorkFolder,
    model: Path,
    config: CompareConfig,
    *,
    garment_model: Path | None = None,
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Measure and draw, unless that has been done; the result's path is the page.

    Args:
        model: folder of `capture4d wrinkles train`.
        garment_model: what `capture4d fit` wrote; WORK/retarget, if there is one, by default.
    Raises:
        InputError: the work folder lacks registration or scans, a model is of another template, or the network learned
            from all frames.
    """
    inputs = open_inputs(work, model, config, garment_model=garment_model, workers=workers)
    stage = open_stage(
        work.path / "compare",
        name="compare",
        schema=SCHEMA,
        config=config,
        upstream=inputs.upstream,
        overwrite=overwrite,
    )
    page = stage.path / "index.html"
    if not page.is_file():  # the last file of a run
        torch.set_num_threads(workers)
        held = inputs.held()
        surfaces = methods(inputs, held)
        capture, truth = work.capture, read_truth_model(work.capture)
        positions = None if truth is None else true_vertices(capture, truth, held.frame_ids)
        table = measure(surfaces.methods, inputs.template, held, positions)
        rows = inputs.rows(held)
        pictures = draw(
            surfaces, inputs.template, held, capture, truth, count=config.pictures, middle=rows[len(rows) // 2]
        )
        missing = inputs.offsets is None and work.registered.garment.skin_weights is not None
        left_out = [f"Offset images: capture4d wrinkles offsets {work.path}"] if missing else []
        _write_table(stage, table, pictures, held.frame_ids, against_truth=truth is not None)
        _write_page(
            page, table, pictures, left_out, name=capture.name, count=len(rows), against_truth=truth is not None
        )
    return stage.finish([page], output=page)


def _write_table(
    stage: Stage, table: Sequence[Row], pictures: Pictures, frame_ids: np.ndarray, *, against_truth: bool
) -> None:
    """compare.json and the pictures that it names."""
    kept = [
        {"frame_id": frame.frame_id, "panels": _keep(stage.path, f"{frame.frame_id:06d}", frame.panels)}
        for frame in pictures.frames
    ]
    people = {"frame_id": pictures.people_frame, "panels": _keep(stage.path, "people", pictures.people)}
    write_json(
        stage.path / "compare.json",
        {
            "frames": frame_ids,
            "against_truth": against_truth,
            "methods": [asdict(row) for row in table],
            "conclusion": conclusion(table, against_truth=against_truth),
            "pictures": kept,
            "people": people,
        },
    )


def _keep(folder: Path, name: str, panels: Sequence[Panel]) -> list[dict[str, str]]:
    """Write pictures; their titles and files."""
    kept = []
    for number, panel in enumerate(panels):
        path = folder / "pictures" / f"{name}-{number}.webp"
        write_panel(path, panel)
        kept.append({"title": panel.title, "file": path.name})
    return kept


def _write_page(
    path: Path,
    table: Sequence[Row],
    pictures: Pictures,
    left_out: Sequence[str],
    *,
    name: str,
    count: int,
    against_truth: bool,
) -> None:
    """index.html.

    Args:
        left_out: what would have a row if it had been learned, and the command that learns it.
        count: held-out frames.
    """
    against = "the true positions" if against_truth else "the registration"
    page = render_page(
        "capture4d.app.compare",
        "compare.html.jinja",
        title=f"{name}: surfaces compared",
        subtitle=f"On {count} held-out frames. Normals are measured against the maps of the scans; vertices against "
        f"{against}. Speed is one frame at a time, not a batch.",
        table=comparison_table([asdict(row) for row in table]),
        learned=LEARNED if any(row.learned for row in table) else "",
        frames=pictures.frames,
        scale=pictures.scale,
        people=pictures.people,
        middle=pictures.people_frame,
        left_out=left_out,
        conclusion=conclusion(table, against_truth=against_truth),
    )
    write_bytes(path, page.encode())
