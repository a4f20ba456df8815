"""The stage that brings a registered sequence in: meshes and a template in, WORK/registration out.

The output is a registered sequence like any other, without scan data: its residuals are NaN.

registration/  stage.json, garment.npz, frames/000123.npz, vertices.npy
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from capture4d.app.importing.config import ImportConfig
from capture4d.app.importing.sequences import read_sequence, sequence_files
from capture4d.captures.work_folder import IMPORT, stack_vertices
from capture4d.files.atomic import file_digest, write_npz
from capture4d.files.outputs import require_apart
from capture4d.files.records import load_garment, save_garment
from capture4d.mesh_files.meshes import read_mesh
from capture4d.runs.progress import progress
from capture4d.runs.stage import StageResult, open_stage
from capture4d.types import Garment

__all__ = ["run"]

SCHEMA = 1


def run(meshes: Path, template: Path, output: Path, config: ImportConfig, *, overwrite: bool = False) -> StageResult:
    """Read every frame, in the template's order of vertices.

    Args:
        meshes: a folder with a mesh file a frame, or a file with all of them.
        template: a template.npz, or a mesh.
        output: WORK/registration.
    Raises:
        InputError: a file is damaged, has other vertices, or lacks a frame rate; or the folder holds something else.
    """
    garment = load_garment(template) if template.suffix.lower() == ".npz" else Garment(read_mesh(template).mesh)
    found = read_sequence(meshes, garment.template, config)
    files = sequence_files(meshes)
    require_apart([output / "garment.npz", output / "vertices.npy"], [template, *files])
    upstream = {
        "meshes": file_digest(files, root=files[0].parent),
        "template": file_digest([template], root=template.parent),
    }
    stage = open_stage(
        output, name=IMPORT, schema=SCHEMA, config={"import": config, "sequence_fps": found.fps},
        upstream=upstream, sources={"meshes": meshes, "template": template}, overwrite=overwrite,
    )  # fmt: skip
    ids = found.frame_ids.tolist()
    paths = [stage.path / "garment.npz", stage.path / "vertices.npy", *(stage.frame_path(each) for each in ids)]
    if stage.was_complete and all(path.is_file() for path in paths):
        return stage.finish(paths, changed=False, frames=len(ids))
    save_garment(stage.path / "garment.npz", garment)
    unknown = np.full(len(garment.template.vertices), np.nan, np.float32)
    with progress("import", len(ids)) as advance:
        for frame_id, vertices in zip(ids, found.frames(), strict=True):
            write_npz(stage.frame_path(frame_id), vertices=vertices, residual_m=unknown)
            advance(1)
    stack_vertices(stage, ids)
    return stage.finish(paths, frames=len(ids))
