"""One function a format: written into a folder of its own, and read back there by another way than it was written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from capture4d.app.export.clip import Clip
from capture4d.app.export.config import ExportConfig, Format
from capture4d.app.export.correctives import FitError, FitLimits, exact_targets, fit_targets
from capture4d.app.export.glb_check import largest_glb_difference
from capture4d.app.export.maps import map_bytes, map_name
from capture4d.app.export.web_page import require_page, write_page
from capture4d.errors import InputError
from capture4d.files.atomic import write_bytes
from capture4d.mesh_files.animated.alembic import read_alembic, write_alembic
from capture4d.mesh_files.animated.moving_mesh import largest_difference
from capture4d.mesh_files.animated.point_caches import read_mdd, read_pc2, write_mdd, write_pc2
from capture4d.mesh_files.animated.usd import read_usd, usd_faults, write_usd
from capture4d.mesh_files.gltf.animated_scene import AnimatedScene, write_animated_glb
from capture4d.mesh_files.meshes import read_mesh, write_mesh
from capture4d.mesh_files.obj import obj_bytes
from capture4d.types import Mesh

__all__ = ["ALBEDO_FILE", "MATERIAL", "Written", "file_of", "write_format", "write_sequence"]

_SUFFIXES: Mapping[Format, str] = {
    "usd": ".usdc", "abc": ".abc", "glb": ".glb", "pc2": ".pc2", "mdd": ".mdd", "html": ".html",
}  # fmt: skip
ALBEDO_FILE, MATERIAL = "albedo.png", "garment.mtl"
"""The cloth's colours, and what tells of them beside an OBJ."""
_SMOOTH = b"s 1\n"
"""One smoothing group: without it Blender shades an OBJ flat."""
_MATERIAL = f"newmtl garment\nKd 1 1 1\nKs 0 0 0\nmap_Kd {ALBEDO_FILE}\n".encode()
EXACT_MM = 0.001
"""What a format that keeps positions as they are may lose."""
_GLB_AGREES_MM = 0.002
"""By how much another reader's GLB may be farther off than the writer's: single precision along the skeleton."""


@dataclass(frozen=True, slots=True)
class Written:
    """What came of a format."""

    file: str
    error_mm: float
    """The largest, over all vertices of all frames that were read back."""
    fit: FitError | None = None
    """Of a GLB."""
    targets: int | None = None
    """Of a GLB: its correcting shapes."""
    faults: Sequence[str] = ()
    """What is above a limit that was asked for."""


def file_of(kind: Format, name: str) -> str | None:
    """The one file of a format, of what bears a name; None where there is a file for each frame."""
    suffix = _SUFFIXES.get(kind)
    return None if suffix is None else f"{name}{suffix}"


def write_format(kind: Format, folder: Path, clip: Clip, config: ExportConfig) -> Written:
    """Write one file into a folder in which normals/ lies, if there are maps, and read it back.

    Raises:
        InputError: the format cannot hold these frames, needs a package that is not installed, or what is read back is
            not what was written.
    """
    path, moving = folder / f"{clip.name}{_SUFFIXES[kind]}", clip.moving
    match kind:
        case "usd":
            maps = [f"./{map_name(frame_id)}" for frame_id in moving.frame_ids.tolist()] if clip.maps else []
            albedo = f"./{ALBEDO_FILE}" if clip.albedo else None
            write_usd(
                path, moving, name=clip.name, maps=maps, albedo=albedo, normals=config.normals, colour=clip.colour
            )
            _require_no_faults(path, usd_faults(path))
            found = read_usd(path)
        case "abc":
            write_alembic(path, moving, normals=config.normals)
            found = read_alembic(path, moving.fps)
        case "glb":
            return _write_glb(path, clip, config)
        case "html":
            return _write_page(path, clip, config)
        case "pc2":
            write_pc2(path, moving)
            found = read_pc2(path, moving.mesh)
        case "mdd":
            assert moving.fps is not None
            write_mdd(path, moving)
            found = read_mdd(path, moving.mesh, moving.fps)
        case _:
            raise AssertionError(f"{kind} has a file for each frame")
    if kind in ("pc2", "mdd"):
        mesh_path = folder / f"{clip.name}.obj"  # the mesh that the cache belongs to
        _write_obj(mesh_path, moving.mesh, folder if clip.albedo else None)
        base = read_mesh(mesh_path).mesh
        _require_close(mesh_path, 1000 * float(np.abs(base.vertices - moving.mesh.vertices).max()), EXACT_MM)
    error = 1000 * largest_difference(moving, found)
    _require_close(path, error, EXACT_MM)
    return Written(path.name, error)


def write_sequence(kind: Format, folder: Path, clip: Clip) -> Written:
    """A mesh file for each frame that has none yet; each is read back."""
    largest, place = 0.0, kind if clip.name == "garment" else f"{clip.name}-{kind}"
    for frame_id, vertices in zip(clip.moving.frame_ids.tolist(), clip.moving.frames(), strict=True):
        path = folder / place / f"{frame_id:06d}.{kind}"
        mesh = clip.moving.mesh.with_vertices(vertices)
        if not path.is_file():
            if kind == "obj":
                _write_obj(path, mesh, path.parent if clip.albedo else None)
            else:
                write_mesh(path, mesh)
        found = read_mesh(path).mesh
        if not np.array_equal(found.faces, mesh.faces):
            raise InputError("read back: expected the faces that were written, found others", where=path)
        largest = max(largest, 1000 * float(np.linalg.norm(found.vertices - mesh.vertices, axis=1).max()))
        _require_close(path, largest, EXACT_MM)
    return Written(f"{place}/", largest)


def _write_obj(path: Path, mesh: Mesh, coloured: Path | None) -> None:
    """Args: coloured: the folder that gets the material, and the colours themselves if they lie above it."""
    head = _SMOOTH
    if coloured is not None:
        if not (coloured / ALBEDO_FILE).exists():  # other tools look beside a file, as our reader does
            write_bytes(coloured / ALBEDO_FILE, (coloured.parent / ALBEDO_FILE).read_bytes())
        if not (coloured / MATERIAL).exists():
            write_bytes(coloured / MATERIAL, _MATERIAL)
        head = f"mtllib {MATERIAL}\nusemtl garment\n".encode() + head
    write_bytes(path, head + obj_bytes(mesh, None, None))


def _write_glb(path: Path, clip: Clip, config: ExportConfig) -> Written:
    moving, glb, skeleton = clip.moving, config.glb, clip.skeleton
    if glb.motion == "exact":
        skeleton = None
        targets, error = exact_targets(moving)
    else:
        scratch = path.with_name("rest.f32")
        limits = FitLimits(glb.p99_mm, glb.max_mm, glb.most)
        targets, error = fit_targets(moving, skeleton, scratch, limits)
        scratch.unlink()
    first = int(moving.frame_ids[0])
    still = None if clip.maps is None else map_bytes(clip.maps, first, 8)
    told = {"targets": len(targets.directions), "error": asdict(error)}
    times = (moving.times_s() - moving.times_s()[0]).astype(np.float32)
    skin = None if skeleton is None else skeleton.scene_skin()
    clock = {"fps": moving.fps, "first_frame": first}
    colours = None if clip.albedo is None else (path.parent / ALBEDO_FILE).read_bytes()
    scene = AnimatedScene(
        moving.mesh, times, targets, skin, still, colours, {"capture4d": told}, clock, clip.name, clip.colour
    )
    write_animated_glb(path, scene)
    found = 1000 * largest_glb_difference(path, moving)
    _require_close(path, found, error.max_mm + _GLB_AGREES_MM)
    at_99, at_most = (glb.p99_mm, glb.max_mm) if glb.motion == "skinned" else (EXACT_MM, EXACT_MM)
    told_of = (("p99_mm", error.p99_mm, at_99), ("max_mm", error.max_mm, at_most))
    faults = [f"{name} {value:.3f} > {limit:g}" for name, value, limit in told_of if value > limit]
    return Written(path.name, error.max_mm, error, len(targets.directions), faults)


def _write_page(path: Path, clip: Clip, config: ExportConfig) -> Written:
    inside = path.with_name("inside.glb")
    made = _write_glb(inside, clip, config)
    write_page(path, inside, clip)
    require_page(path, inside, clip)
    inside.unlink()
    return replace(made, file=path.name)


def _require_close(path: Path, error_mm: float, limit_mm: float) -> None:
    if not error_mm <= limit_mm:
        raise InputError(f"read back: expected vertices within {limit_mm:.4f} mm, found {error_mm:.4f}", where=path)


def _require_no_faults(path: Path, faults: Sequence[str]) -> None:
    if faults:
        raise InputError(f"read back: expected what USD's validators pass, found: {faults[0][:200]}", where=path)
