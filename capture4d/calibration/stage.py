"""Calibration and check of a rig, as files: a folder of board images in, rig.json and calibration.json out."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.calibration.board_images import PATTERN, BoardImage, find_images, natural_order, read_grey
from capture4d.calibration.check import CameraCheck, check_rig
from capture4d.calibration.config import CALIBRATION, RIG_CHECK, CalibrationConfig, RigCheckConfig
from capture4d.calibration.corners import detect_corners
from capture4d.calibration.other_boards import what_is_shown
from capture4d.calibration.report import calibration_report
from capture4d.calibration.rig import calibrate_rig
from capture4d.calibration.start import usable_views
from capture4d.calibration.uncertainty import CAMERA_UNKNOWNS
from capture4d.cameras.board import Board, BoardView, parse_board
from capture4d.cameras.colmap import write_model
from capture4d.errors import InputError
from capture4d.files.arrays import ArrayFile
from capture4d.files.atomic import read_json, write_json, write_npz
from capture4d.files.outputs import new_files, new_files_in, require_apart, require_free
from capture4d.files.records import load_rig, save_rig
from capture4d.runs.file_stage import open_file_stage
from capture4d.runs.stage import StageResult
from capture4d.runs.workers import run_jobs

__all__ = ["CalibrationResult", "read_covariance", "run", "run_check"]

DETECTOR = "fitted pattern, 2"
"""Corners that an earlier detector has kept are found anew."""
REPORT, CORNERS, COVARIANCE = "calibration.json", "calibration_corners.npz", "calibration_covariance.npz"
RECORD, PAGE = "calibration_stage.json", "calibration.html"
SCHEMA = 1


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class CalibrationResult(StageResult):
    """A rig that was calibrated, and how good it is."""

    report: Mapping[str, Any]
    """What calibration.json says."""


@dataclass(frozen=True, slots=True, eq=False)
class _Detection:
    image: BoardImage
    size: tuple[int, int]
    ids: np.ndarray
    pixels: np.ndarray


def run(
    images: Path,
    output: Path,
    board: str,
    config: CalibrationConfig = CALIBRATION,
    *,
    pattern: str = PATTERN,
    colmap: Path | None = None,
    workers: int = 1,
    overwrite: bool = False,
) -> CalibrationResult:
    """Calibrate the rig that took a folder of images, unless that is done.

    The corners are kept beside the rig, so that a run after a failure, with more images or with other settings, detects
    only new images.

    Args:
        output: rig.json to write; calibration.json goes beside it.
        board: as `parse_board` takes it.
        pattern: how the images lie in the folder.
        colmap: folder for the rig as a COLMAP model as well.
        overwrite: calibrate anew, also over a rig of other settings, or one that was not calibrated here.
    Raises:
        InputError: names the image, the camera, or the argument at fault; or a file that would be written over.
        StaleError: there is a rig that was calibrated with other settings.
    """
    geometry = parse_board(board)
    found = find_images(images, pattern)
    poses = sorted({image.pose for image in found}, key=natural_order)
    if config.floor is not None and config.floor not in poses:
        raise InputError(f"--floor: expected one of the poses {poses[0]} to {poses[-1]}, found '{config.floor}'")
    stage = open_file_stage(
        output.with_name(RECORD),
        name="calibrate",
        schema=SCHEMA,
        config={"board": board, "pattern": pattern, **dataclasses.asdict(config)},
        upstream={"images": _images_digest(found, images)},
        sources={"images": images},
        overwrite=overwrite,
    )
    files = [output, output.with_name(REPORT), output.with_name(COVARIANCE)]
    digest = stage.made(files)
    photographs = [image.path for image in found]
    if digest is None:
        if not overwrite and not any(output.with_name(name).is_file() for name in (RECORD, CORNERS)):
            _require_none([*files, output.with_name(PAGE)])
        require_apart(files, photographs)
        detections = _detect_all(found, geometry, output.with_name(CORNERS), images, workers)
        with new_files(files, inputs=photographs, overwrite=True) as workshop:
            _calibrate(detections, workshop / output.name, board, geometry, config)
            if not overwrite and not stage.may_replace(files):  # the rig decides: what is said of it tells times, too
                require_free(output, workshop / output.name)
        digest = stage.finish(files)
    if colmap is not None:
        with new_files_in(colmap, inputs=photographs, overwrite=overwrite) as workshop:
            write_model(workshop, load_rig(output))
    return CalibrationResult(output, digest, report=read_json(output.with_name(REPORT)))


def _require_none(files: Sequence[Path]) -> None:
    """Raise if one of these files, which no run before has made, is there: before work is done for nothing."""
    there = next((path for path in files if path.exists()), None)
    if there is not None:
        raise InputError("expected no file yet, or that of an earlier run; found another; use --overwrite", where=there)


def _calibrate(
    detections: Sequence[_Detection], output: Path, board: str, geometry: Board, config: CalibrationConfig
) -> None:
    """Write the rig, its report, and what is uncertain about it."""
    found = [detection.image for detection in detections]
    names, poses = (sorted({getattr(image, key) for image in found}, key=natural_order) for key in ("camera", "pose"))
    sizes = _image_sizes(detections, names)
    views = _views(detections, names, poses)
    _require_seen(found, views, names, geometry)
    calibration = calibrate_rig(
        views,
        geometry,
        names=names,
        image_sizes=sizes,
        poses=len(poses),
        floor=None if config.floor is None else poses.index(config.floor),
        config=config,
    )
    save_rig(output, calibration.estimate.rig)
    report = calibration_report(calibration, geometry, pose_names=poses, config=config)
    report = {"format": 1, "board": board, "images": len(found), "config": dataclasses.asdict(config), **report}
    digest = _rig_digest(output)
    write_npz(
        output.with_name(COVARIANCE), names=np.array(names), covariance=calibration.covariance, rig=np.array(digest)
    )
    write_json(output.with_name(REPORT), {**report, "rig": digest})


def run_check(
    rig_path: Path,
    images: Path,
    config: RigCheckConfig = RIG_CHECK,
    *,
    board: str | None = None,
    pattern: str = PATTERN,
    workers: int = 1,
) -> list[CameraCheck]:
    """Test every camera of a calibrated rig against images of the board.

    Args:
        board: if None, the one in the calibration.json beside the rig.
    Raises:
        InputError: names the file, the camera or the argument at fault.
    """
    rig = load_rig(rig_path)
    beside = rig_path.with_name(REPORT)
    digest = _rig_digest(rig_path)
    report = read_json(beside) if beside.is_file() else {}
    spec = board or (report.get("board") if report.get("rig") == digest else None)
    if spec is None:
        fault = f"{beside} is of another {rig_path.name}" if report else f"there is no {beside} that names it"
        raise InputError(f"--board: expected one, for {fault}")
    geometry = parse_board(spec)
    found = find_images(images, pattern)
    strangers = sorted({image.camera for image in found} - set(rig.names))
    if strangers:
        raise InputError(f"expected cameras of {rig_path}, found {', '.join(strangers)}", where=images)
    poses = sorted({image.pose for image in found}, key=natural_order)
    detections = list(run_jobs(partial(_detect, geometry), found, workers=workers, label="find the board"))
    detections.sort(key=lambda detection: (detection.image.camera, natural_order(detection.image.pose)))
    for detection in detections:
        width, height = (int(size) for size in rig.image_sizes[rig.names.index(detection.image.camera)])
        if detection.size != (width, height):
            seen = "x".join(str(size) for size in detection.size)
            raise InputError(
                f"expected {width}x{height} pixels as in the rig, found {seen}", where=detection.image.path
            )
    views = _views(detections, rig.names, poses)
    if not views:
        _require_seen(found, views, sorted({image.camera for image in found}, key=natural_order), geometry)
    covariance = read_covariance(rig_path, cameras=len(rig.names))
    return check_rig(rig, views, geometry, covariance=covariance, config=config)


# --- detections --------------------------------------------------------------------------------------------------


def _detect(board: Board, image: BoardImage) -> _Detection:
    picture = read_grey(image.path)
    ids, pixels = detect_corners(picture, board)
    return _Detection(image, (picture.shape[1], picture.shape[0]), ids, pixels)


def _detect_all(
    images: Sequence[BoardImage], board: Board, cache: Path, folder: Path, workers: int
) -> list[_Detection]:
    """Detect the corners of all images but those that an earlier run has seen, in the order of the images."""
    known = _read_corners(cache, board)
    keys = {image: _file_key(image, folder) for image in images}
    new = [image for image in images if keys[image] not in known]
    detections = {image: known[keys[image]] for image in images if keys[image] in known}
    try:
        for detection in run_jobs(partial(_detect, board), new, workers=workers, label="find the board"):
            detections[detection.image] = (detection.size, detection.ids, detection.pixels)
    finally:  # an image that cannot be read must not cost those that can
        if new and detections:
            _write_corners(cache, board, {keys[image]: detections[image] for image in images if image in detections})
    return [_Detection(image, *detections[image]) for image in images]


def _write_corners(
    cache: Path, board: Board, found: Mapping[str, tuple[tuple[int, int], np.ndarray, np.ndarray]]
) -> None:
    write_npz(
        cache,
        board=np.array(f"{board}, {DETECTOR}"),
        keys=np.array(list(found)),
        sizes=np.array([size for size, _, _ in found.values()], np.int32),
        counts=np.array([len(ids) for _, ids, _ in found.values()], np.int32),
        ids=np.concatenate([ids for _, ids, _ in found.values()]),
        pixels=np.concatenate([pixels for _, _, pixels in found.values()]),
    )


def _read_corners(cache: Path, board: Board) -> dict[str, tuple[tuple[int, int], np.ndarray, np.ndarray]]:
    if not cache.is_file():
        return {}
    with ArrayFile(cache) as arrays:
        if str(arrays["board"]) != f"{board}, {DETECTOR}":
            return {}
        ends = np.cumsum(arrays["counts"])[:-1]
        return {
            str(key): ((int(size[0]), int(size[1])), ids, pixels)
            for key, size, ids, pixels in zip(
                arrays["keys"],
                arrays["sizes"],
                np.split(arrays["ids"], ends),
                np.split(arrays["pixels"], ends),
                strict=True,
            )
        }


def _file_key(image: BoardImage, folder: Path) -> str:
    """Changes when the file does."""
    status = image.path.stat()
    return f"{image.path.relative_to(folder).as_posix()} {status.st_size} {status.st_mtime_ns}"


def _images_digest(images: Sequence[BoardImage], folder: Path) -> str:
    return hashlib.sha256("\n".join(sorted(_file_key(image, folder) for image in images)).encode()).hexdigest()


def _image_sizes(detections: Sequence[_Detection], names: Sequence[str]) -> np.ndarray:
    """(C, 2) int32: width and height, which have to be the same in all images of a camera."""
    first: dict[str, _Detection] = {}
    for detection in detections:
        usual = first.setdefault(detection.image.camera, detection)
        if detection.size != usual.size:
            expected, seen = ("x".join(str(size) for size in entry.size) for entry in (usual, detection))
            raise InputError(
                f"expected {expected} pixels as in {usual.image.path.name}, found {seen}", where=detection.image.path
            )
    return np.array([first[name].size for name in names], np.int32)


def _require_seen(images: Sequence[BoardImage], views: Sequence[BoardView], names: Sequence[str], board: Board) -> None:
    """Raise unless every camera sees the board.

    Raises:
        InputError: says which board the images show instead, if that can be told.
    """
    seeing = {names[view.camera] for view in usable_views(views, board)}
    blind = [name for name in names if name not in seeing]
    if blind:
        says = what_is_shown([image.path for image in images if image.camera in blind], board)
        where = "it nowhere" if not seeing else f"none of {', '.join(blind)}"
        wanted = "in some of them" if not seeing else "in images of every camera"
        raise InputError(f"images: expected the board {wanted}, found {where}; {says}")


def _views(detections: Sequence[_Detection], names: Sequence[str], poses: Sequence[str]) -> list[BoardView]:
    camera_index = {name: index for index, name in enumerate(names)}
    pose_index = {name: index for index, name in enumerate(poses)}
    return [
        BoardView(camera_index[entry.image.camera], pose_index[entry.image.pose], entry.ids, entry.pixels)
        for entry in detections
        if len(entry.ids)
    ]


def _rig_digest(path: Path) -> str:
    """What the files beside a rig.json name it by."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def read_covariance(rig_path: Path, *, cameras: int) -> np.ndarray | None:
    """Of the calibration beside a rig, (C, 14, C, 14), if it is that of this rig."""
    path = rig_path.with_name(COVARIANCE)
    if not path.is_file():
        return None
    with ArrayFile(path) as arrays:
        if str(arrays.get("rig")) != _rig_digest(rig_path):
            return None
        covariance = arrays["covariance"]
    if covariance.shape != (cameras, CAMERA_UNKNOWNS) * 2:
        raise InputError(
            f"expected {cameras} x {CAMERA_UNKNOWNS} unknowns squared, found {covariance.shape}", where=path
        )
    return covariance
