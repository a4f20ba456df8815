"""Any template onto any scan: two mesh files in, the deformed template and its measures out.

A template that its file splits at UV seams is joined there while it is registered, and comes back vertex for vertex:
what lay in one place lies in one place.

Everything is brought to one size before anything is decided by a length: the template's bounding box gets the diagonal
of a shirt, for which the constants are made. Units therefore change the numbers of the report and nothing else.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64
from scipy.spatial import KDTree

from capture4d.captures.scan_files import whole_surface
from capture4d.colours.spaces import format_colour, parse_colour
from capture4d.errors import InputError
from capture4d.files.atomic import nan_to_none, read_json, write_json
from capture4d.files.outputs import new_files, require_apart
from capture4d.geometry.mesh import boundary_loops, submesh
from capture4d.geometry.seams import weld
from capture4d.mesh_files.meshes import WRITABLE, read_coloured_mesh, read_mesh, write_mesh
from capture4d.types import Garment, GarmentScan, Mesh
from capture4d.units import METRES, Units
from registration.config import MeshRegistrationConfig
from registration.floor import find_floor
from registration.landmarks import Landmarks, read_landmarks
from registration.mesh_fit import fit_mesh
from registration.mesh_verdict import judge
from registration.quality import FrameQuality, assess

__all__ = ["FindBorder", "MeshRegistration", "register_mesh", "run"]

FindBorder = Callable[..., tuple[np.ndarray, np.ndarray]]
"""Mesh, colours, paint in; points on the painted border out, and on the inner rim of its paint.
`capture4d.extraction.garment.painted_border` is one."""

DIAGONAL = 1.2
"""Diagonal of the template's bounding box while it is registered, metres: a shirt's."""
CM_BELOW = 200.0
"""Diagonals from 8 to here are taken for centimetres: a shirt's is 90 to 140 cm, and a hand's 200 mm."""


@dataclass(frozen=True, slots=True, eq=False)
class MeshRegistration:
    """A registered mesh."""

    vertices: Float32[np.ndarray, "verts 3"]
    """In the template's order and the files' unit; vertices that a seam splits stay in one place, bit for bit."""
    start: Float64[np.ndarray, "verts 3"]
    """The template after pre-alignment, in the files' unit."""
    quality: FrameQuality
    """Judged on the normalised problem; all its lengths, those in `reasons` too, are of the files' world."""
    way: str = ""
    """Which attempt counts: near, far, again, wide, sized, or soft (`registration.mesh_fit`)."""
    estimated: bool = False
    """The scan came as points alone; its faces are made between them."""
    floor_percent: float = 0.0
    """Share of the scan's vertices that were left out as a floor or a wall which the template does not have."""
    notes: tuple[str, ...] = ()
    """What in the files could not be used, each with the file's name."""


def run(
    template_path: Path,
    scan_path: Path,
    output_path: Path,
    config: MeshRegistrationConfig,
    *,
    landmarks_path: Path | None = None,
    find_border: FindBorder | None = None,
    overwrite: bool = False,
) -> MeshRegistration:
    """Register one mesh file to another; writes the result, and its measures as JSON beside it.

    Args:
        landmarks_path: pairs of places on the template and on the scan, as `registration.landmarks` reads them.
        output_path: .ply, .obj, .glb or .off; the JSON has the same name.
        overwrite: write over files that hold something else than this result.
    Raises:
        InputError: the output is no mesh file, or is one of the inputs, or is there already and something else; an
            input is missing, damaged or empty, the colour is not in the scan, or the sizes cannot belong to one unit.
    """
    begin = time.process_time()
    if output_path.suffix.lower() not in WRITABLE:
        raise InputError(
            f"expected a mesh file ({', '.join(WRITABLE)}), found '{output_path.suffix}'", where=output_path
        )
    outputs, inputs = [output_path, output_path.with_suffix(".json")], [template_path, scan_path]
    inputs += [] if landmarks_path is None else [landmarks_path]
    require_apart(outputs, inputs)
    known = _earlier(outputs, str(template_path), str(scan_path), overwrite)
    read_scan = read_coloured_mesh if config.border_colour else read_mesh
    template_file, scan_file = read_mesh(template_path), read_scan(scan_path, faces_needed=False)
    landmarks = None
    if landmarks_path is not None:
        landmarks = read_landmarks(landmarks_path, template_file.mesh, scan_file.mesh)
    result = register_mesh(
        template_file.mesh,
        scan_file.mesh,
        landmarks=landmarks,
        colours=scan_file.colours,
        config=config,
        find_border=find_border,
        template_name=str(template_path),
        scan_name=str(scan_path),
    )
    mesh = template_file.mesh.with_vertices(result.vertices)
    units = config.units if config.units != "auto" else guess_units(template_file.mesh)
    measures = {
        "template": str(template_path),
        "scan": str(scan_path),
        "units": units,
        "scan_faces": "estimated" if result.estimated else "given",
        "scan_floor_percent": round(result.floor_percent, 2),
        "way": result.way,
        "verdict": result.quality.verdict,
        "reasons": list(result.quality.reasons),
        **nan_to_none(result.quality.numbers),
    }
    same = {key: value for key, value in known.items() if key != "cpu_s"} == measures
    cpu_s = known["cpu_s"] if same and "cpu_s" in known else round(time.process_time() - begin, 4)
    with new_files(outputs, inputs=inputs, overwrite=overwrite) as workshop:
        write_mesh(workshop / output_path.name, mesh, polygon_sizes=template_file.polygon_sizes)
        write_json(workshop / outputs[1].name, {**measures, "cpu_s": cpu_s})
    noted = ((template_path, template_file.notes), (scan_path, scan_file.notes), (scan_path, _told(result)))
    return replace(result, notes=tuple(f"{path}: {note}" for path, notes in noted for note in notes))


def _told(result: MeshRegistration) -> tuple[str, ...]:
    """What was left out of the scan, or not found in it."""
    if result.floor_percent == 0.0:
        return result.notes
    floor = f"a floor or wall, {result.floor_percent:.0f} % of the scan, is left out; the template has none"
    return (floor, *result.notes)


def _unfound(config: MeshRegistrationConfig, border_points: int) -> tuple[str, ...]:
    """That paint which is there shows no border."""
    if not config.border_colour or border_points:
        return ()
    paint = format_colour(parse_colour(config.border_colour))
    reason = f"no border is found by its paint {paint}: the cloth has that colour too, or no open edge has it"
    return (f"{reason}; registered without painted borders",)


def _earlier(outputs: Sequence[Path], template: str, scan: str, overwrite: bool) -> Mapping[str, Any]:
    """The measures of an earlier run on these files, which may have had the same result; empty if there are none.

    Raises:
        InputError: there are outputs of something else, before any work is done for nothing.
    """
    there = [path for path in outputs if path.exists()]
    if overwrite or not there:
        return {}
    report = outputs[-1]
    known = read_json(report) if report.is_file() else {}
    if (known.get("template"), known.get("scan")) == (template, scan):
        return known
    raise InputError("expected no file yet, or this very result; found another; use --overwrite", where=there[0])


def register_mesh(
    template: Mesh,
    scan: Mesh,
    *,
    colours: np.ndarray | None = None,
    config: MeshRegistrationConfig,
    find_border: FindBorder | None = None,
    landmarks: Landmarks | None = None,
    template_name: str = "template",
    scan_name: str = "scan",
) -> MeshRegistration:
    """Deform a template onto a scan; both in one unit, of any kind.

    Args:
        scan: may have no faces; they are made between its points then.
        colours: (S, 3) uint8 of the scan's vertices, needed for `config.border_colour`.
        template_name, scan_name: how errors call them.
    """
    split = weld(template.vertices, template.faces)
    template = Mesh(template.vertices[split.first], split.faces)
    size = _diagonal(template.vertices)
    _require_one_unit(size, _diagonal(scan.vertices), template_name, scan_name)
    try:
        surface = whole_surface(scan, colours)
    except InputError as error:
        raise error.at(scan_name) from None
    scale, origin = DIAGONAL / size, template.vertices.astype(np.float64).mean(axis=0)

    def normalised(points: np.ndarray) -> np.ndarray:
        return scale * (points.astype(np.float64) - origin)

    start = normalised(template.vertices)
    shown, colours, floor_percent = _without_floor(
        replace(surface.mesh, vertices=normalised(surface.mesh.vertices).astype(np.float32)),
        surface.colours,
        start,
        template,
    )
    garment_scan, rim_points = _garment_scan(shown, colours, find_border, config, scan_name)
    loops = {f"border_{index}": loop for index, loop in enumerate(boundary_loops(template.faces))}
    if config.border_colour and not loops:
        raise InputError(f"{template_name}: expected open borders, for --border-colour is given; found none")
    garment = Garment(Mesh(start.astype(np.float32), template.faces), loops)
    marks = None
    if landmarks is not None:
        nearest = KDTree(template.vertices).query(landmarks.on_template)[1]
        marks = np.asarray(nearest, np.int64), normalised(landmarks.on_scan)
    fitted = fit_mesh(garment, garment_scan, start, config, landmarks=marks, rim_points=rim_points)
    metres = METRES[config.units if config.units != "auto" else guess_units(template)]
    factor, limits = metres / scale, config.registration.quality
    quality = assess(fitted.analysis, fitted.scan, fitted.vertices, limits, length_factor=factor)
    verdict, reasons = judge(
        quality,
        fitted.analysis,
        fitted.scan,
        fitted.vertices,
        config.scan_fit,
        start=fitted.start,
        length_factor=factor,
    )
    return MeshRegistration(
        vertices=(fitted.vertices / scale + origin).astype(np.float32)[split.of_vertex],
        start=(fitted.start / scale + origin)[split.of_vertex],
        quality=_at_vertices(replace(quality, verdict=verdict, reasons=reasons), split.of_vertex),
        way=fitted.way,
        estimated=surface.estimated,
        floor_percent=floor_percent,
        notes=_unfound(config, len(garment_scan.boundary_points)),
    )


def _at_vertices(quality: FrameQuality, of_vertex: np.ndarray) -> FrameQuality:
    """What is known of each welded vertex, for all that it stands for."""
    return replace(
        quality,
        residual_m=quality.residual_m[of_vertex],
        border_error_m=quality.border_error_m[of_vertex],
        stretch=quality.stretch[of_vertex],
        flipped=quality.flipped[of_vertex],
    )


def guess_units(mesh: Mesh) -> Units:
    """m, cm or mm, from the diagonal of the bounding box, for things between a hand and a garment."""
    size = _diagonal(mesh.vertices)
    return "m" if size < 8.0 else "cm" if size < CM_BELOW else "mm"


def _diagonal(vertices: np.ndarray) -> float:
    return float(np.linalg.norm(np.ptp(vertices.astype(np.float64), axis=0)))


def _require_one_unit(template: float, scan: float, template_name: str, scan_name: str) -> None:
    if not template > 0.0 or not scan > 0.0:
        name = scan_name if template > 0.0 else template_name
        raise InputError(f"{name}: expected a mesh with an extent, found all vertices in one place")
    if not 0.05 < scan / template < 20.0:
        raise InputError(
            f"{scan_name}: expected the unit of {template_name}, which is {template:.4g} across; "
            f"found {scan:.4g} across"
        )


def _without_floor(
    scan: Mesh, colours: np.ndarray | None, start: np.ndarray, template: Mesh
) -> tuple[Mesh, np.ndarray | None, float]:
    """The scan and its colours without a floor that the template does not have, and its share of the vertices in per
    cent."""
    on_floor = find_floor(scan.vertices.astype(np.float64), scan.faces)
    if on_floor is None or find_floor(start, template.faces) is not None:
        return scan, colours, 0.0
    kept_faces = np.asarray(~on_floor[scan.faces].any(axis=1))
    shown, kept = submesh(scan, kept_faces)
    return shown, None if colours is None else colours[kept], 100.0 * float(on_floor.mean())


def _garment_scan(
    mesh: Mesh,
    colours: np.ndarray | None,
    find_border: FindBorder | None,
    config: MeshRegistrationConfig,
    name: str,
) -> tuple[GarmentScan, np.ndarray | None]:
    """The whole scan, with the border points that its paint shows; and the paint's inner rim."""
    if not config.border_colour:
        none = np.zeros((0, 3), np.float32)
        return GarmentScan(submesh(mesh, np.ones(len(mesh.faces), bool))[0], none, np.zeros(0, np.int32), (), 0), None
    if colours is None:
        raise InputError(f"{name}: expected a colour per vertex for --border-colour, found none")
    assert find_border is not None, "a painted border needs somebody who finds it"
    points, rim = find_border(mesh, colours, parse_colour(config.border_colour), source=name)
    return GarmentScan(mesh, points, np.full(len(points), -1, np.int32), (), 0), rim
