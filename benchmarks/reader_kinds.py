"""Every kind of file that capture4d reads: how one is made, small and whole, and how it is read.

A new reader is a line of `KINDS`: `python -m benchmarks readers` and `tests/property/test_damaged_files.py` go through
them all.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import pickle
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from benchmarks import reader_exports, reader_models
from benchmarks.reader_values import (
    BLENDSHAPES,
    BODY,
    GARMENT,
    MESH,
    POSES,
    RIG,
    RNG,
    SMPL,
    SMPL_BODY,
    SMPL_POSES,
)
from capture4d.app.importing.config import ImportConfig
from capture4d.app.importing.sequences import read_sequence
from capture4d.body.smpl import read_smpl
from capture4d.cameras.colmap import read_model, write_model
from capture4d.captures.capture import Capture, read_capture, read_scan, write_capture_description
from capture4d.captures.garment_scans import load_garment_scan, save_garment_scan
from capture4d.captures.truth import (
    TruthFrame,
    TruthModel,
    read_truth_frame,
    read_truth_model,
    write_truth_frame,
    write_truth_model,
)
from capture4d.captures.work_folder import load_records, load_registration, open_work
from capture4d.errors import InputError
from capture4d.files.arrays import map_array
from capture4d.files.atomic import read_json, read_json_lines, write_json, write_json_lines, write_npy, write_npz
from capture4d.files.records import (
    load_body,
    load_garment,
    load_poses,
    load_rig,
    save_body,
    save_garment,
    save_poses,
    save_rig,
)
from capture4d.files.tensors import read_tensors, write_tensors
from capture4d.mesh_files.animated.moving_mesh import MovingMesh
from capture4d.mesh_files.animated.point_caches import write_mdd, write_pc2
from capture4d.mesh_files.gltf.animated_scene import AnimatedScene, SceneTargets, write_animated_glb
from capture4d.mesh_files.meshes import read_coloured_mesh, read_mesh, write_mesh
from capture4d.motions.bvh import Bvh, format_bvh, moved_by_root
from capture4d.motions.motion_files import read_motion, write_amass, write_bvh
from capture4d.runs.stage import open_stage, require_complete
from capture4d.templates.cage_files import read_cage
from capture4d.types import GarmentScan
from data_synth.mesh_sequence import open_sequence
from retarget.shapes.files import load_blendshapes, save_blendshapes
from wrinkles.normal_maps.pair_files import read_map
from wrinkles.normal_maps.spaces import encode_png
from wrinkles.offset_images.editing.config import PictureFormat
from wrinkles.offset_images.editing.operations import read_operations
from wrinkles.offset_images.editing.picture_files import read_change, write_picture

__all__ = ["BY_NAME", "KINDS", "Kind", "fault_of", "laid_out", "whole"]


@dataclass(frozen=True)
class Kind:
    """How a file is made in an empty folder, and how it is read there."""

    name: str
    """Where it lies in that folder; what is damaged."""
    make: Callable[[Path], Any]
    """May write others beside it."""
    read: Callable[[Path], Any]
    optional: bool = False
    """Without it there is a value all the same."""
    refused: bool = False
    """Even whole it is no value here, but a line."""
    names_other: bool = False
    """A fault may be said of a file that is read with it."""


# --- meshes and pictures -------------------------------------------------------------------------------------------


def _textured_glb(path: Path) -> None:
    import trimesh

    model: Any = trimesh.Trimesh(MESH.vertices, MESH.faces, process=False)
    picture = Image.fromarray(RNG.integers(0, 256, (4, 4, 3), np.uint8))
    visual: Any = importlib.import_module("trimesh.visual")
    material = visual.material.PBRMaterial(baseColorTexture=picture)
    model.visual = visual.TextureVisuals(RNG.random((6, 2)), material=material)
    data = trimesh.Scene(model).export(file_type="glb")
    assert isinstance(data, bytes)
    path.write_bytes(data)


def _text_ply(path: Path) -> None:
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    colours = "property uchar red\nproperty uchar green\nproperty uchar blue\n"
    faces = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    path.write_text(f"{head}{colours}{faces}0 0 0 1 2 3\n1 0 0 4 5 6\n1 1 0 7 8 9\n3 0 1 2\n")


def _picture(kind: str) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        stream = io.BytesIO()
        Image.fromarray(RNG.integers(0, 256, (4, 4, 3), np.uint8)).save(stream, kind)
        path.write_bytes(stream.getvalue())
        _materials(path.with_name("mesh.mtl"), path.name)

    return make


def _materials(path: Path, picture: str = "skin.png") -> None:
    path.write_text(f"newmtl skin\nmap_Kd {picture}\n")
    if not (path.parent / picture).exists():
        Image.fromarray(RNG.integers(0, 256, (4, 4, 3), np.uint8)).save(path.parent / picture)
    path.with_name("mesh.obj").write_text(
        "mtllib mesh.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl skin\nf 1/1 2/2 3/3\n"
    )


def _beside(path: Path) -> Any:
    return read_coloured_mesh(path.with_name("mesh.obj"))


_OFFSETS = RNG.standard_normal((8, 8, 3)).astype(np.float32)


def _drawn(ending: PictureFormat) -> Kind:
    def read(path: Path) -> np.ndarray:
        with tempfile.TemporaryDirectory() as folder:
            return read_change(path, write_picture(Path(folder) / path.name, _OFFSETS, ending))

    return Kind(f"front.{ending}", lambda path: write_picture(path, _OFFSETS, ending), read)


def _normal_map(path: Path) -> None:
    path.write_bytes(encode_png(RNG.random((4, 4, 3)) - 0.5, RNG.random((4, 4)) < 0.5))


def _board_image(path: Path) -> None:
    Image.fromarray(RNG.integers(0, 256, (32, 32), np.uint8)).save(path)


def _detect(path: Path) -> Any:
    from capture4d.calibration.stage import BoardImage, _detect  # pyright: ignore[reportPrivateUsage]
    from capture4d.cameras.board import parse_board

    return _detect(parse_board("charuco:5x4:60:44:DICT_4X4_50"), BoardImage("a", "1", path))


# --- motions -------------------------------------------------------------------------------------------------------


def _other_bvh(path: Path) -> None:
    """Joints that are called as CMU calls them."""
    from scipy.spatial.transform import Rotation

    names = ("Hips", "LowerBack", "Spine", "Neck", "Head", "LeftArm", "LeftForeArm", "LeftHand")
    rotations = np.tile(np.eye(3), (2 * len(names), 1, 1))
    parents, offsets = np.array([-1, *range(len(names) - 1)]), RNG.random((len(names), 3))
    motion = Bvh(path, names, parents, offsets, Rotation.from_matrix(rotations),
                 moved_by_root(offsets, np.zeros((2, 3))), 0.01)  # fmt: skip
    path.write_text(format_bvh(motion, np.ones((len(names), 3))))


# --- captures and work folders -------------------------------------------------------------------------------------


def _capture(path: Path) -> None:
    write_capture_description(Capture(path.parent, "take", 60.0, (1, 2), (1, 2, 3), {"hem": (4, 5, 6)}))


def _capture_of(path: Path) -> Capture:
    return Capture(path.parents[1], "take", 60.0, (1, 2), None)


def _scan(path: Path) -> None:
    _capture(path.parents[1] / "capture.json")
    for frame in (1, 2):
        write_mesh(path.with_name(f"{frame:06d}.ply"), MESH, colours=np.zeros((6, 3), np.uint8))


def _garment_scan(path: Path) -> None:
    points = RNG.random((4, 3), np.float32)
    save_garment_scan(path, GarmentScan(MESH, points, np.zeros(4, np.int32), ("hem",), 1))


def _truth_model(path: Path) -> None:
    write_truth_model(path, TruthModel(MESH, GARMENT.loops, np.zeros(4, np.int32), np.zeros((4, 3), np.float32)))


def _truth_frame(path: Path) -> None:
    rotations, translations = POSES.rotations[0], POSES.translations[0]
    write_truth_frame(path, TruthFrame(MESH.vertices, rotations, translations, np.zeros(5, np.uint8)))


def _registration(path: Path) -> None:
    """WORK/registration of two frames, whichever file of it `path` is."""
    folder = path if path.name == "registration" else next(each for each in path.parents if each.name == "registration")
    stage = open_stage(folder, name="register", schema=1, config={"weight": 1.0}, upstream={"garment": "aa"})
    save_garment(folder / "garment.npz", GARMENT)
    for frame in (1, 2):
        write_npz(stage.frame_path(frame), vertices=MESH.vertices, residual_m=np.zeros(6, np.float32))
    write_npy(folder / "vertices.npy", np.stack([MESH.vertices] * 2))
    write_json_lines(folder / "metrics.jsonl", [{"frame_id": 1, "verdict": "good"}, {"frame_id": 2, "verdict": "bad"}])
    stage.finish([folder / "garment.npz"])


def _read_registration(path: Path) -> Any:
    return load_registration(next(each for each in path.parents if each.name == "registration"))


def _read_stage(path: Path) -> Any:
    work = open_work(path.parents[1])
    return work, require_complete(path.parent, "register", "capture4d register", made_from={"garment": "aa"})


def _continued(path: Path) -> Any:
    stage = open_stage(path.parent, name="register", schema=1, config={"weight": 1.0}, upstream={"garment": "aa"})
    return stage.was_complete


def _read_sequence(path: Path) -> Any:
    sequence = open_sequence(path)
    return [sequence.read(frame_id) for frame_id in sequence.frame_ids]


def _any_body(read: Callable[..., Any], body: Any, path: Path) -> Any:
    return read(path, body)


_on_body = partial(_any_body, read_motion, BODY)
_on_smpl = partial(_any_body, read_motion, SMPL_BODY)
_COLOURS = np.zeros((6, 3), np.uint8)
_POLYGONS = np.array([4, 3], np.int32)


def _colmap(name: str, *, text: bool, optional: bool = False) -> Kind:
    return Kind(name, lambda path: write_model(path.parent, RIG, text=text), lambda path: read_model(path.parent),
                optional=optional, names_other=True)  # fmt: skip


MOVING = MovingMesh(MESH, np.array([3, 4], np.int32), 50.0, lambda: iter([MESH.vertices, MESH.vertices]))


def _moving(path: Path) -> list[np.ndarray]:
    return list(read_sequence(path, MESH, ImportConfig(fps=50.0)).frames())


def _moving_glb(path: Path) -> None:
    """One target, seen whole in the second frame."""
    shape, times = MESH.vertices, np.array([0, 0.02], np.float32)
    weights, clock = np.array([[0], [1]], np.float32), {"fps": 50.0, "first_frame": 3}
    targets = SceneTargets(
        shape, 0 * shape + np.array([0, 0, 1], np.float32), 0.1 * shape[None], 0 * shape[None], weights, ["a"]
    )
    write_animated_glb(path, AnimatedScene(MESH, times, targets, scene_extras=clock))


KINDS = [
    Kind("mesh.obj", lambda path: write_mesh(path, MESH, polygon_sizes=_POLYGONS), read_coloured_mesh),
    Kind("coloured.obj", lambda path: write_mesh(path, MESH, colours=_COLOURS), read_coloured_mesh),
    Kind("mesh.ply", lambda path: write_mesh(path, MESH, colours=_COLOURS), read_coloured_mesh),
    Kind("polygons.ply", lambda path: write_mesh(path, MESH, polygon_sizes=_POLYGONS), read_coloured_mesh),
    Kind("text.ply", _text_ply, read_coloured_mesh),
    Kind("mesh.glb", lambda path: write_mesh(path, MESH, colours=_COLOURS), read_coloured_mesh),
    Kind("textured.glb", _textured_glb, read_coloured_mesh),
    Kind("plain.glb", lambda path: write_mesh(path, MESH), read_mesh),
    Kind("mesh.mtl", _materials, _beside, names_other=True),
    *(Kind(f"skin.{ending}", _picture(kind), _beside, names_other=True)
      for ending, kind in (("png", "png"), ("jpg", "jpeg"), ("tif", "tiff"), ("bmp", "bmp"), ("webp", "webp"),
                           ("tga", "tga"))),
    Kind("cache.pc2", lambda path: write_pc2(path, MOVING), _moving),
    Kind("moving.glb", _moving_glb, _moving),
    Kind("cache.mdd", lambda path: write_mdd(path, MOVING), _moving),
    Kind("body.npz", lambda path: save_body(path, BODY), load_body),
    Kind("garment.npz", lambda path: save_garment(path, GARMENT), load_garment),
    Kind("poses.npz", lambda path: save_poses(path, POSES), load_poses),
    Kind("motion.npz", lambda path: save_poses(path, POSES), _on_body),
    Kind("resampled.npz", lambda path: save_poses(path, POSES), lambda path: read_motion(path, BODY, fps=50.0)),
    Kind("amass.npz", lambda path: write_amass(path, SMPL_BODY, SMPL_POSES), _on_smpl),
    Kind("motion.bvh", lambda path: write_bvh(path, BODY, POSES), _on_body),
    Kind("other.bvh", _other_bvh, _on_smpl, refused=True),  # which lacks most joints
    Kind("smpl.npz", lambda path: np.savez(path, allow_pickle=False, **SMPL), read_smpl),
    Kind("smpl.pkl", lambda path: path.write_bytes(pickle.dumps(SMPL, protocol=2)), read_smpl),
    Kind("text.pkl", lambda path: path.write_bytes(pickle.dumps(SMPL, protocol=0)), read_smpl),
    Kind("rig.json", lambda path: save_rig(path, RIG), load_rig),
    Kind("any.json", lambda path: write_json(path, {"a": [1, 2.5, None], "b": {"c": "d"}}), read_json),
    Kind("rows.jsonl", lambda path: write_json_lines(path, [{"a": 1}, {"a": 2.5}]), read_json_lines),
    Kind("capture.json", _capture, lambda path: read_capture(path.parent, scans=False)),
    Kind("scans/000001.ply", _scan, lambda path: read_scan(read_capture(path.parents[1]), 1)),
    _colmap("cameras.bin", text=False),
    _colmap("images.bin", text=False),
    _colmap("frames.bin", text=False, optional=True),
    _colmap("cameras.txt", text=True),
    _colmap("images.txt", text=True),
    _colmap("frames.txt", text=True, optional=True),
    Kind("blendshapes.safetensors", lambda path: save_blendshapes(path, BLENDSHAPES), load_blendshapes),
    Kind("any.safetensors", lambda path: write_tensors(path, "test", {"a": np.ones((2, 3), np.float32)}, {"b": [1]}),
         lambda path: read_tensors(path, "test").entry("b")),
    *(Kind(f"{name}.safetensors", make, read) for name, (make, read) in reader_models.MODELS.items()),
    *(Kind(name, make, read, names_other=name.endswith((".obj", ".ply", ".gltf")))
      for name, (make, read) in reader_exports.EXPORTS.items()),
    *(Kind(name, make, read, names_other=True) for name, (make, read) in reader_exports.BESIDE.items()),
    Kind("truth/model.npz", _truth_model, lambda path: read_truth_model(_capture_of(path)), optional=True),
    Kind("truth/000001.npz", _truth_frame, lambda path: read_truth_frame(_capture_of(path), 1)),
    Kind("scan.npz", _garment_scan, lambda path: load_garment_scan(path, 1)),
    Kind("sequence.npz", lambda path: write_npz(path, vertices=RNG.random((2, 6, 3)), faces=MESH.faces),
         _read_sequence),
    Kind("vertices.npy", lambda path: write_npy(path, RNG.random((4, 6, 3), np.float32)), map_array),
    Kind("labels.npy", lambda path: write_npy(path, RNG.integers(0, 9, 12)), read_cage),
    Kind("cage.json", lambda path: write_json(path, {"curves": [[0, 3, 5], [1, 2]]}), read_cage),
    Kind("operations.json", lambda path: write_json(path, {"operations": [
        {"do": "paint", "height_cm": 1.5, "stroke": [[0.5, 0.5]]}, {"do": "transfer", "from": "other"}]}),
         read_operations),
    *(_drawn(ending) for ending in ("tif", "exr", "png")),
    Kind("map.png", _normal_map, read_map),
    Kind("board.png", _board_image, _detect),
    Kind("registration/frames/000001.npz", _registration, _read_registration, names_other=True),
    Kind("registration/vertices.npy", _registration, _read_registration, names_other=True),
    Kind("registration/stage.json", _registration, _read_stage, names_other=True),
    Kind("registration/metrics.jsonl", _registration, lambda path: load_records(path.parent)),
]  # fmt: skip
BY_NAME = {kind.name: kind for kind in KINDS}


@lru_cache
def whole(name: str) -> dict[str, bytes]:
    """A file of a kind, and what lies beside it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.parent.mkdir(parents=True, exist_ok=True)
        BY_NAME[name].make(path)
        files = (file for file in Path(folder).rglob("*") if file.is_file())
        return {file.relative_to(folder).as_posix(): file.read_bytes() for file in files}


@contextlib.contextmanager
def laid_out(files: dict[str, bytes], name: str) -> Iterator[Path]:
    """The files in a fresh folder; the path of the one that is called so."""
    with tempfile.TemporaryDirectory() as folder:
        for file, data in files.items():
            (Path(folder) / file).parent.mkdir(parents=True, exist_ok=True)
            (Path(folder) / file).write_bytes(data)
        yield Path(folder) / name


def fault_of(kind: Kind, path: Path) -> tuple[Any, InputError | None]:
    """The value of a file, or what is said of it instead."""
    try:
        return kind.read(path), None
    except InputError as error:
        return None, error
