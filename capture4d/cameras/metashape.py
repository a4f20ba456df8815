"""The cameras of an Agisoft Metashape XML ("Export Cameras", or a project's document): frame cameras and fisheyes.

Metashape's camera axes are ours (x right, y down, z forward). A pixel is u = w / 2 + cx + x' (f + b1) + y' b2 and
v = h / 2 + cy + y' f, counted from the corner of the image, with x' and y' the distorted coordinates; its p1 is our p2,
and its p2 our p1 (Metashape manual, appendix "Camera models"). A camera's transform takes its axes to those of its
component or chunk, whose own transform, with a scale, takes them to the world.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np
from jaxtyping import Float64

from capture4d.cameras.names import camera_names
from capture4d.cameras.projection import Lens
from capture4d.errors import InputError
from capture4d.files.reading import reading
from capture4d.types import Rig

__all__ = ["read_metashape"]

HALF_PIXEL = 0.5
_DEEPEST = 50
"""Elements inside each other; a camera lies in a few groups at most."""
_BROWN, _FISHEYE = ("frame",), ("fisheye", "equidistant_fisheye")
_UNKNOWN_TO_US = ("b2", "skew", "p3", "p4")


def read_metashape(path: Path) -> tuple[Rig, list[str]]:
    """The cameras that are aligned and enabled, called after their labels; and which were left out, with the reason.

    Raises:
        InputError: not such a file, no aligned camera in it, several chunks or components without a common world, or a
            lens that is none of ours; names the camera or sensor.
    """
    with reading(path, "Metashape XML"):
        root = _parse(path.read_bytes())
        chunks = [root] if root.tag == "chunk" else list(root.iter("chunk"))
        if not chunks:
            raise InputError(f"expected a Metashape document with a chunk, found <{root.tag[:40]}>")
        aligned = [chunk for chunk in chunks if chunk.get("enabled", "true") in ("true", "1") and _aligned(chunk)[0]]
        if not aligned:
            raise InputError("expected cameras with a transform, found none that is enabled and aligned")
        if len(aligned) > 1:
            labels = ", ".join(repr(chunk.get("label", "")) for chunk in aligned[:5])
            raise InputError(f"expected one chunk with aligned cameras, found {labels}; export one of them")
        return _chunk_rig(aligned[0])


def _chunk_rig(chunk: ElementTree.Element) -> tuple[Rig, list[str]]:
    cameras, left_out = _aligned(chunk)
    labels = [camera.get("label") or f"camera_{camera.get('id')}" for camera in cameras]
    worlds = _worlds(chunk, cameras)
    sensors = {sensor.get("id"): sensor for sensor in chunk.iterfind("sensors/sensor")}
    lenses, sizes, transforms = [], [], []
    for label, camera in zip(labels, cameras, strict=True):
        sensor = sensors.get(camera.get("sensor_id"))
        if sensor is None:
            raise InputError(
                f"camera {label!a}: expected its sensor {camera.get('sensor_id')}, found none of this number"
            )
        lens, size = _sensor(sensor)
        lenses.append(lens)
        sizes.append(size)
        try:
            transforms.append(_camera_from_world(camera, worlds[camera.get("component_id")]))
        except InputError as error:
            raise InputError(f"camera {label!a}: {error.reason}") from None
    rig = Rig(
        names=camera_names(labels),
        intrinsics=np.stack([lens.intrinsics for lens in lenses]),
        distortion=np.stack([lens.distortion for lens in lenses]),
        T_camera_world=np.stack(transforms),
        image_sizes=np.array(sizes, np.int32),
        lenses=tuple(lens.model for lens in lenses),
    )
    return rig, left_out


def _aligned(chunk: ElementTree.Element) -> tuple[list[ElementTree.Element], list[str]]:
    cameras, left_out = [], []
    for camera in chunk.iterfind("cameras//camera"):
        label = camera.get("label") or f"camera_{camera.get('id')}"
        if camera.get("enabled", "true") not in ("true", "1"):
            left_out.append(f"{label} (disabled)")
        elif camera.find("transform") is None:
            part = camera.get("master_id") is not None
            left_out.append(f"{label} ({'placed by its camera system alone' if part else 'not aligned'})")
        else:
            cameras.append(camera)
    return cameras, left_out


# --- places ------------------------------------------------------------------------------------------------------


def _camera_from_world(
    camera: ElementTree.Element, world: tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, " 3"], float]
) -> Float64[np.ndarray, "4 4"]:
    T_local_camera = _numbers(camera.find("transform"), "transform", 16).reshape(4, 4)
    rotation, translation, scale = world
    matrix = np.eye(4)
    matrix[:3, :3] = (rotation @ T_local_camera[:3, :3]).T
    matrix[:3, 3] = -matrix[:3, :3] @ (scale * rotation @ T_local_camera[:3, 3] + translation)
    return matrix


def _worlds(
    chunk: ElementTree.Element, cameras: Sequence[ElementTree.Element]
) -> dict[str | None, tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, " 3"], float]]:
    """Rotation, translation and scale from the axes of each component with cameras to the world."""
    components = {part.get("id"): part for part in chunk.iterfind("components/component")}
    used = sorted({camera.get("component_id") or "" for camera in cameras})
    places = {part: components[part].find("transform") if part in components else None for part in used}
    if len(used) > 1 and any(place is None for place in places.values()):
        named = ", ".join(
            repr(components[part].get("label", part) if part in components else part) for part in used[:5]
        )
        raise InputError(f"expected cameras of one component, found some of {named}, which share no world; export one")
    of_chunk = chunk.find("transform")
    return {part or None: _similarity(of_chunk if place is None else place) for part, place in places.items()}


def _similarity(
    transform: ElementTree.Element | None,
) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, " 3"], float]:
    rotation, translation, scale = np.eye(3), np.zeros(3), 1.0
    if transform is not None:
        if transform.find("rotation") is not None:
            rotation = _numbers(transform.find("rotation"), "rotation", 9).reshape(3, 3)
        if transform.find("translation") is not None:
            translation = _numbers(transform.find("translation"), "translation", 3)
        if transform.find("scale") is not None:
            scale = float(_numbers(transform.find("scale"), "scale", 1)[0])
    if not scale > 0:
        raise InputError(f"expected a positive scale of the chunk, found {scale:g}")
    return rotation, translation, scale


# --- lenses ------------------------------------------------------------------------------------------------------


def _sensor(sensor: ElementTree.Element) -> tuple[Lens, tuple[int, int]]:
    label = sensor.get("label") or sensor.get("id") or ""
    try:
        kinds = {part.get("class", "adjusted"): part for part in reversed(sensor.findall("calibration"))}
        calibration = kinds.get("adjusted", kinds.get("initial"))
        if calibration is None:
            raise InputError("expected a calibration, found none")
        resolution = calibration.find("resolution")
        resolution = sensor.find("resolution") if resolution is None else resolution
        if resolution is None:
            raise InputError("expected a resolution, found none")
        width, height = int(resolution.get("width", "")), int(resolution.get("height", ""))
        if not (0 < width < 2**31 and 0 < height < 2**31):
            raise InputError(f"expected the size of an image, found {width} x {height}")
        return _lens(calibration, calibration.get("type", sensor.get("type", "frame")), width, height), (width, height)
    except (InputError, ValueError) as error:
        reason = error.reason if isinstance(error, InputError) else f"expected whole pixels as resolution ({error})"
        raise InputError(f"sensor {label!a}: {reason}") from None


def _lens(calibration: ElementTree.Element, kind: str, width: int, height: int) -> Lens:
    fisheye = kind in _FISHEYE
    if not fisheye and kind not in _BROWN:
        raise InputError(f"expected a camera of {', '.join(_BROWN + _FISHEYE)}, found {kind!r}")
    if calibration.find("f") is None:
        raise InputError("expected f, as Metashape writes it since its version 1.3, found none")
    given = {part.tag: float(_numbers(part, part.tag, 1)[0]) for part in calibration if part.tag in _VALUES}
    f, cx, cy, b1, k1, k2, k3, k4, p1, p2 = (given.get(name, 0.0) for name in _VALUES[:10])
    not_ours = ("p1", "p2", *_UNKNOWN_TO_US) if fisheye else ("k4", *_UNKNOWN_TO_US)
    for name in not_ours:
        if given.get(name, 0.0) != 0:
            raise InputError(f"expected no {name} of a {kind} camera, which our lenses lack, found {given[name]:g}")
    centre = width / 2 + cx - HALF_PIXEL, height / 2 + cy - HALF_PIXEL
    K = np.array([[f + b1, 0, centre[0]], [0, f, centre[1]], [0, 0, 1]])
    coefficients = [k1, k2, k3, k4, 0.0] if fisheye else [k1, k2, p2, p1, k3]
    return Lens(K, np.array(coefficients), "fisheye" if fisheye else "brown")


_VALUES = ("f", "cx", "cy", "b1", "k1", "k2", "k3", "k4", "p1", "p2", *_UNKNOWN_TO_US)


def _numbers(element: ElementTree.Element | None, name: str, count: int) -> Float64[np.ndarray, " count"]:
    words = (element.text or "").split() if element is not None else []
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        raise InputError(f"expected {count} finite numbers as {name}, found '{' '.join(words)[:60]}'")
    return values


# --- XML ---------------------------------------------------------------------------------------------------------


def _parse(data: bytes) -> ElementTree.Element:
    """The tree of a file without a document type: entities grow without bound, or read other files."""
    builder, parser, depth = ElementTree.TreeBuilder(), expat.ParserCreate(), 0

    def refuse(*_: object) -> None:
        raise InputError("expected XML without a document type (<!DOCTYPE>), found one")

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > _DEEPEST:
            raise InputError(f"expected at most {_DEEPEST} elements inside each other, found more")
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse
    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise InputError(f"not valid XML ({error})", line=error.lineno) from None
    return builder.close()
