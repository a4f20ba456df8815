"""The stage that scans a sequence of meshes: any cloth in, an ordinary capture folder with truth out.

Meshes of one topology (all the same faces) give exact truth: the surface of every frame, and the true position of every
template vertex. Sequences whose faces change are scanned too, without truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree

from capture4d.captures.capture import Capture, write_capture_description, write_scan
from capture4d.captures.truth import TruthFrame, TruthModel, write_truth_frame, write_truth_model
from capture4d.colours.spaces import parse_colour
from capture4d.errors import InputError
from capture4d.files.atomic import file_digest
from capture4d.files.records import load_rig, save_garment, save_rig
from capture4d.geometry.mesh import boundary_loops
from capture4d.geometry.ray_casting import closest_points
from capture4d.heavy_imports import import_open3d
from capture4d.mesh_files.meshes import read_mesh
from capture4d.runs.stage import Stage, StageResult, open_stage
from capture4d.runs.workers import run_jobs
from capture4d.types import Garment, Mesh, Rig
from data_synth.mesh_sequence import MeshSequence, open_sequence
from data_synth.scan_files import pending_scans
from data_synth.scanner.border_paint import PaintedSheet, paint_borders
from data_synth.scanner.config import ScanConfig
from data_synth.scanner.rig import bounding_sphere, scanner_rig
from data_synth.scanner.scan import LABEL_GARMENT, Surface, scan_surfaces

__all__ = ["paint_like", "run"]

SCHEMA = 2
MODEL = "truth/model.npz"
ROTATIONS = {
    "x": [[0, 1, 0], [1, 0, 0], [0, 0, -1]],
    "y": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "z": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
}
"""Turns the axis that points up into Y."""


def run(
    meshes: Path,
    output: Path,
    config: ScanConfig,
    *,
    template: Path | None = None,
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Scan every mesh that has no whole scan yet, or has lost its truth; the digest of the capture.

    Args:
        meshes: folder of mesh files, or npz with vertices (T, V, 3) and faces (F, 3).
        output: capture folder.
        template: mesh to register later. It lies on the first mesh, or is the same mesh in another pose.
    Raises:
        InputError: there are no meshes, or one is damaged, or the template has nothing to do with them.
    """
    colours = [parse_colour(text) for text in config.border_colours]
    garment_colour = parse_colour(config.garment_colour)
    source = _open_source(meshes, config)
    upstream = {"meshes": source.sequence.digest()}
    if template is not None:
        upstream["template"] = file_digest([template], root=template.parent)
    stage = open_stage(output, name="scan", schema=SCHEMA, config=config, upstream=upstream, overwrite=overwrite)
    same_topology = _prepare(stage, source, template)
    pending = set(pending_scans(stage, source.frame_ids))
    if same_topology:
        pending.update(stage.pending(source.frame_ids, folder="truth"))
    prepare = partial(_open_scene, stage, source, same_topology)
    for _ in run_jobs(_scan_frame, sorted(pending), prepare=prepare, workers=workers, label="scan"):
        pass
    garment = source.loop_names if colours and config.border_paint_m > 0 else ()
    write_capture_description(
        Capture(
            path=output,
            name=meshes.stem,
            fps=config.fps,
            frame_ids=source.frame_ids,
            garment_colour=garment_colour,
            boundary_colours={name: colours[index % len(colours)] for index, name in enumerate(garment)},
        )
    )
    files = [output / name for name in ("capture.json", "rig.json", "template.npz")]
    files += [stage.frame_path(frame_id, ".ply", folder="scans") for frame_id in source.frame_ids]
    if same_topology:
        files.append(output / MODEL)
        files += [stage.frame_path(frame_id, folder="truth") for frame_id in source.frame_ids]
    return stage.finish(files)


@dataclass(frozen=True, slots=True, eq=False)
class _Source:
    """A sequence in metres and with Y up."""

    sequence: MeshSequence
    config: ScanConfig
    frame_ids: tuple[int, ...]
    """The chosen ones."""
    scale: float
    first: Mesh
    """Of the chosen ones."""

    @property
    def loop_names(self) -> tuple[str, ...]:
        return tuple(f"border_{index}" for index in range(len(boundary_loops(self.first.faces))))

    def mesh(self, frame_id: int) -> Mesh:
        return self.upright(self.sequence.read(frame_id))

    def upright(self, mesh: Mesh) -> Mesh:
        """A mesh of the sequence's files, or the template's, in metres and with Y up."""
        return _upright(mesh, self.scale, self.config)


def _open_source(path: Path, config: ScanConfig) -> _Source:
    sequence = open_sequence(path)
    chosen = sequence.frame_ids[config.first_frame :: config.step][: config.frames]
    if not chosen:
        raise InputError(f"no frame left from number {config.first_frame} on", where=path)
    first, scale = sequence.read(chosen[0]), 1.0
    if config.height_m is not None:
        scale = config.height_m / float(np.ptp(first.vertices[:, "xyz".index(config.up)]))
    return _Source(sequence, config, chosen, scale, _upright(first, scale, config))


def _upright(mesh: Mesh, scale: float, config: ScanConfig) -> Mesh:
    rotation = np.array(ROTATIONS[config.up], float)
    return mesh.with_vertices((scale * mesh.vertices.astype(float) @ rotation.T).astype(np.float32))


def _prepare(stage: Stage, source: _Source, template: Path | None) -> bool:
    """Write rig, template and truth model where missing; whether all meshes have the same faces."""
    first = source.first
    model, rig, own = stage.path / MODEL, stage.path / "rig.json", stage.path / "template.npz"
    lost = not model.is_file() and model.parent.is_dir()
    if lost or not rig.is_file() or not own.is_file():
        same, lower, upper = True, first.vertices.min(axis=0), first.vertices.max(axis=0)
        for frame_id in source.frame_ids[1:]:
            mesh = source.mesh(frame_id)
            same &= mesh.faces.shape == first.faces.shape and bool((mesh.faces == first.faces).all())
            lower, upper = np.minimum(lower, mesh.vertices.min(axis=0)), np.maximum(upper, mesh.vertices.max(axis=0))
        garment, faces, barycentric = _template(source, first, template)
        save_garment(own, garment)
        if same:
            loops = dict(zip(source.loop_names, boundary_loops(first.faces), strict=True))
            write_truth_model(model, TruthModel(first, loops, faces, barycentric))
        corners = np.stack([lower, upper])
        centre, radius = bounding_sphere(corners)
        save_rig(rig, scanner_rig(source.config.scanner, centre=centre, radius=radius))
    return model.is_file()


def _template(source: _Source, first: Mesh, path: Path | None) -> tuple[Garment, np.ndarray, np.ndarray]:
    """The template, and the point of the first mesh (face, barycentric) under each of its vertices."""
    names = source.loop_names
    if path is None and source.config.template_vertices is None:
        return Garment(first, dict(zip(names, boundary_loops(first.faces), strict=True))), *_own_vertices(first)
    mesh = source.upright(read_mesh(path).mesh) if path else _decimated(first, source.config.template_vertices or 0)
    same_mesh = mesh.faces.shape == first.faces.shape and bool((mesh.faces == first.faces).all())
    if same_mesh and len(mesh.vertices) == len(first.vertices):
        return Garment(mesh, dict(zip(names, boundary_loops(first.faces), strict=True))), *_own_vertices(first)
    if boundary_loops(mesh.faces) and not names:
        raise InputError(
            f"expected a closed template, as the first mesh of {source.sequence.path} is; found one with open borders",
            where=path,
        )
    points, faces, barycentric = closest_points(first, mesh.vertices)
    distance = np.linalg.norm(points - mesh.vertices, axis=1).mean()
    size = np.ptp(first.vertices, axis=0).max()
    if distance > 0.01 * size:
        raise InputError(
            f"expected a template that lies on the first mesh of {source.sequence.path}, or has its faces, "
            f"found one that is {distance / size:.0%} of its size away",
            where=path,
        )
    return Garment(mesh, _matched_loops(mesh, first, names)), faces, barycentric


def _own_vertices(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Each vertex as a point of one of its faces."""
    face, corner = np.zeros(len(mesh.vertices), np.int32), np.zeros(len(mesh.vertices), np.int64)
    face[mesh.faces] = np.arange(len(mesh.faces), dtype=np.int32)[:, None]
    corner = (mesh.faces[face] == np.arange(len(mesh.vertices))[:, None]).argmax(axis=1)
    return face, np.eye(3, dtype=np.float32)[corner]


def _matched_loops(mesh: Mesh, first: Mesh, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """The template's border loops under the names of the sequence's loops nearest to them."""
    loops = boundary_loops(mesh.faces)
    distances = _loop_distances(mesh, first)
    found: dict[str, np.ndarray] = {}
    for loop, nearest in zip(loops, distances.argmin(axis=1) if loops else [], strict=True):
        found.setdefault(names[nearest], loop)
    return found


def _loop_distances(mesh: Mesh, first: Mesh) -> np.ndarray:
    """Mean distance of each border loop of a mesh, the longest first, to each of the first mesh."""
    trees = [KDTree(first.vertices[loop]) for loop in boundary_loops(first.faces)]
    loops = boundary_loops(mesh.faces)
    distances = [tree.query(mesh.vertices[loop])[0].mean() for loop in loops for tree in trees]
    return np.array(distances).reshape(len(loops), len(trees))


def _decimated(mesh: Mesh, vertices: int) -> Mesh:
    """About `vertices` vertices by quadric error, borders kept."""
    o3d = import_open3d()
    legacy = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices.astype(float)), o3d.utility.Vector3iVector(mesh.faces)
    )
    target = int(len(mesh.faces) * vertices / len(mesh.vertices))
    simple = legacy.simplify_quadric_decimation(target, boundary_weight=10.0)
    return Mesh(np.asarray(simple.vertices, np.float32), np.asarray(simple.triangles, np.int32))


def paint_like(mesh: Mesh, first: Mesh, config: ScanConfig) -> PaintedSheet:
    """Paint each border as the one of the first mesh that it is: which is the longest may change with the faces."""
    colours = [parse_colour(text) for text in config.border_colours]
    return paint_borders(
        mesh,
        width_m=config.border_paint_m,
        garment_colour=parse_colour(config.garment_colour),
        border_colours=[colours[loop % len(colours)] for loop in _same_loops(mesh, first)] if colours else [],
        max_edge_m=config.scanner.fusion.garment_voxel_m,
    )


def _same_loops(mesh: Mesh, first: Mesh) -> list[int]:
    """The border loop of the first mesh that each loop of a mesh is: one to one the nearest, where the meshes are laid
    on each other; further loops are those next to them."""
    middle = mesh.vertices.mean(axis=0) - first.vertices.mean(axis=0)
    distances = _loop_distances(mesh.with_vertices(mesh.vertices - middle), first)
    if not distances.size:
        return list(range(len(distances)))
    found = distances.argmin(axis=1)
    rows, columns = linear_sum_assignment(distances)
    found[rows] = columns
    return found.tolist()


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """What all frames are scanned with."""

    stage: Stage
    source: _Source
    rig: Rig
    sheet: PaintedSheet | None
    """The painted cloth of every frame, if all have the same faces."""


def _open_scene(stage: Stage, source: _Source, same_topology: bool) -> _Scene:
    sheet = paint_like(source.first, source.first, source.config) if same_topology else None
    return _Scene(stage, source, load_rig(stage.path / "rig.json"), sheet)


def _scan_frame(scene: _Scene, frame_id: int) -> None:
    """Scan one mesh; truth first, for the frame counts as done once its scan is there."""
    stage, source, config = scene.stage, scene.source, scene.source.config
    mesh = source.mesh(frame_id)
    sheet = scene.sheet or paint_like(mesh, source.first, config)
    surface = Surface(
        sheet.posed(mesh.vertices), sheet.colours, LABEL_GARMENT, config.scanner.fusion.garment_voxel_m, sheet.painted
    )
    scan, labels = scan_surfaces(
        scene.rig,
        [surface],
        config=config.scanner,
        rng=np.random.default_rng([config.seed, frame_id]),
        frame_id=frame_id,
        time_s=frame_id / config.fps,
    )
    if scene.sheet is not None:
        none = np.zeros((0, 3, 3), np.float32), np.zeros(3, np.float32)
        write_truth_frame(stage.frame_path(frame_id, folder="truth"), TruthFrame(mesh.vertices, *none, labels))
    write_scan(stage.frame_path(frame_id, ".ply", folder="scans"), scan)
