"""The stage that hands a garment on: WORK in, WORK/exports out.

stage.json            what was made, and from what
export.json           of each file, how large its error is; frames and rate
garment.usdc ...      a file for each format; obj/000123.obj and ply/000123.ply
body.usdc ...         the body, if it goes along; body.bvh, its motion; scans/000123.ply, those of the take
normals/000123.png    normal maps, if there are any
albedo.png            the cloth's colours, if they are known; garment.mtl names it
open_in_blender.py    opens all of it with rate, range, material, colours and maps

A format is what a frame is to other stages: what is there is not made again, and one more can be added.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.app.export.albedo import write_albedo
from capture4d.app.export.along import MOTION, body_clip, require_along, write_body_motion, write_scans
from capture4d.app.export.clip import Clip, read_clip
from capture4d.app.export.config import ExportConfig, Format
from capture4d.app.export.correctives import FitError
from capture4d.app.export.maps import map_name, write_maps
from capture4d.app.export.writers import ALBEDO_FILE, MATERIAL, Written, file_of, write_format, write_sequence
from capture4d.captures.work_folder import WorkFolder
from capture4d.errors import InputError
from capture4d.files.atomic import TEMPORARY_SUFFIX, read_json, write_bytes, write_json
from capture4d.files.optional_packages import ALEMBIC, USD, is_installed
from capture4d.files.outputs import new_files_in
from capture4d.runs.frame_lists import listed
from capture4d.runs.progress import progress
from capture4d.runs.stage import Stage, StageResult, open_stage

__all__ = ["SCRIPT", "Exported", "default_format", "possible_formats", "run"]

SCHEMA = 1
_PACKAGES = {"usd": USD, "abc": ALEMBIC}
_RECORD = "export.json"
SCRIPT = "open_in_blender.py"


@dataclass(frozen=True, slots=True)
class Exported:
    """What was exported."""

    result: StageResult
    """Its path is the folder."""
    written: Sequence[Written]
    """Of each format that was asked for."""
    notes: Sequence[str]
    """What is worth telling, a sentence each."""


def default_format() -> Format:
    """USD where it can be written, else GLB."""
    return "usd" if is_installed(USD) else "glb"


def possible_formats(wanted: Sequence[Format]) -> tuple[list[Format], list[str]]:
    """Those whose packages are installed, and of each other one a sentence."""
    absent = [kind for kind in wanted if kind in _PACKAGES and not is_installed(_PACKAGES[kind])]
    said = [f"{kind} is left out: pip install 'capture4d[{_PACKAGES[kind][1]}]' adds it" for kind in absent]
    return [kind for kind in wanted if kind not in absent], said


def run(
    work: WorkFolder,
    output: Path,
    formats: Sequence[Format],
    config: ExportConfig,
    *,
    frames: str = "",
    overwrite: bool = False,
) -> Exported:
    """Write the formats that are not there yet, each read back before it gets its name.

    Args:
        output: folder to write.
        frames: those that are exported, such as 1-200:5; all if empty.
    Raises:
        InputError: nothing is registered, a format cannot hold these frames, or its package is not installed.
    """
    require_along(work, config.along)
    digest = work.registered_digest
    clip = read_clip(work, frames, with_maps=config.maps != "none", albedo=config.albedo)
    ids = clip.moving.frame_ids.tolist()
    upstream = {"registration": digest} | ({} if clip.maps is None else {"maps": clip.maps.digest})
    upstream |= {} if clip.albedo is None else {"albedo": clip.albedo.digest}
    stage = open_stage(
        output, name="export", schema=SCHEMA, config={"export": config, "frames": listed(ids, 0)},
        upstream=upstream, sources={"work": work.path}, overwrite=overwrite,
    )  # fmt: skip
    for left in output.glob(f".capture4d.*{TEMPORARY_SUFFIX}"):  # of a run that was killed
        shutil.rmtree(left, ignore_errors=True)
    record = _record(stage)
    written = []
    with progress("export", len(formats) + (clip.maps is not None) + len(config.along)) as advance:
        if clip.maps is not None:
            write_maps(stage.path, clip.maps, ids, int(config.maps))
            advance(1)
        if clip.albedo is not None and not (stage.path / ALBEDO_FILE).is_file():
            write_albedo(stage.path / ALBEDO_FILE, clip.albedo, clip.moving.mesh)
        for kind in formats:
            written.append(_made(kind, stage, clip, config, record))
            advance(1)
        notes = [*clip.notes, *_write_along(stage, work, clip, formats, config, record)]
        advance(len(config.along))
    _write_script(stage, clip, record)
    made = (path for path in stage.path.rglob("*") if path.is_file() and not path.name.startswith("."))
    paths = sorted(path for path in made if path.name != "stage.json")
    return Exported(stage.finish(paths, frames=len(ids)), written, notes)


def _record(stage: Stage) -> dict[str, Any]:
    path = stage.path / _RECORD
    return read_json(path) if path.is_file() else {"files": {}}


def _clock(clip: Clip) -> dict[str, Any]:
    return {"fps": clip.moving.fps, "frames": clip.moving.frame_ids.tolist()}


def _made(kind: Format, stage: Stage, clip: Clip, config: ExportConfig, record: dict[str, Any]) -> Written:
    """What is told of a format: it is written, unless it is there."""
    key = kind if clip.name == "garment" else f"{clip.name} {kind}"
    known = _known(stage, record, key)
    each = known or _write(kind, stage, clip, config)
    if known is None:
        record["files"][key] = asdict(each)
        write_json(stage.path / _RECORD, record | _clock(clip))
    return each


def _write_along(
    stage: Stage,
    work: WorkFolder,
    clip: Clip,
    formats: Sequence[Format],
    config: ExportConfig,
    record: dict[str, Any],
) -> list[str]:
    """Write what goes along, as far as it is not there; what is worth telling."""
    said = []
    if "body" in config.along:
        body = body_clip(work, clip)
        for kind in formats:
            if kind != "html":  # the page shows the garment
                _made(kind, stage, body, config, record)
        if not (stage.path / MOTION).is_file():
            if len({*np.diff(clip.moving.frame_ids).tolist()}) <= 1:
                write_body_motion(stage.path / MOTION, work, clip)
            else:
                said.append("the motion is left out: a bvh holds frames that are evenly apart alone")
    if "scans" in config.along:
        lost = write_scans(stage.path, work, clip.moving.frame_ids.tolist())
        if lost:
            said.append(f"scans of {len(lost)} frames are damaged or gone, and left out: {listed(lost)}")
    return said


def _known(stage: Stage, record: dict[str, Any], key: str) -> Written | None:
    """What is told of a format that was written by an earlier run and is still there."""
    told = record["files"].get(key)
    if told is None or not (stage.path / told["file"]).exists():
        return None
    fit = None if told["fit"] is None else FitError(**told["fit"])
    return Written(told["file"], told["error_mm"], fit, told["targets"], tuple(told["faults"]))


def _write(kind: Format, stage: Stage, clip: Clip, config: ExportConfig) -> Written:
    if file_of(kind, clip.name) is None:
        return write_sequence(kind, stage.path, clip)
    with new_files_in(stage.path, overwrite=True) as workshop:
        for beside in ("normals", ALBEDO_FILE, MATERIAL):  # as they will lie beside the file
            if (stage.path / beside).exists():
                (workshop / beside).symlink_to(stage.path.resolve() / beside)
        try:
            return write_format(kind, workshop, clip, config)
        except InputError as error:
            raise error if error.where else error.at(stage.path / (file_of(kind, clip.name) or kind)) from None


def _write_script(stage: Stage, clip: Clip, record: dict[str, Any]) -> None:
    """open_in_blender.py, for what is there."""
    order = [record["files"][kind]["file"] for kind in ("usd", "abc", "glb", "pc2", "mdd") if kind in record["files"]]
    if not order:
        return
    ids = clip.moving.frame_ids
    steps = np.diff(ids)
    take = {
        "files": order,
        "fps": clip.moving.fps,
        "first": int(ids[0]),
        "last": int(ids[-1]),
        "step": int(steps[0]) if len(steps) else 1,
        "maps": Path(map_name(int(ids[0]))).name if clip.maps is not None else None,
        "albedo": ALBEDO_FILE if clip.albedo is not None else "",
    }
    text = files("capture4d.app.export").joinpath("open_in_blender.txt").read_text(encoding="utf-8")
    said = json.dumps(take).replace("null", "None")
    write_bytes(stage.path / SCRIPT, text.replace("TAKE = {}", f"TAKE = {said}", 1).encode())
