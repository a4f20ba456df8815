"""Whatever was done to a file of any kind: its value, or one line that names it; no warning, and little memory."""

import contextlib
import io
import pickle
import re
import struct
import tempfile
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from capture4d.body.smpl import read_smpl
from capture4d.cameras.colmap import read_model, write_model
from capture4d.cameras.metashape import read_metashape
from capture4d.cameras.nerfstudio import read_transforms
from capture4d.captures.capture import Capture, read_capture, write_capture_description
from capture4d.captures.garment_scans import load_garment_scan, save_garment_scan
from capture4d.captures.truth import (
    TruthFrame,
    TruthModel,
    read_truth_frame,
    read_truth_model,
    write_truth_frame,
    write_truth_model,
)
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
from capture4d.mesh_files.meshes import read_coloured_mesh, write_mesh
from capture4d.motions.bvh import Bvh, format_bvh, moved_by_root
from capture4d.motions.motion_files import read_motion, write_amass, write_bvh
from capture4d.types import BlendshapeModel, Body, Garment, GarmentScan, Mesh, PoseSequence, Rig
from data_synth.mesh_sequence import open_sequence
from retarget.shapes.files import load_blendshapes, save_blendshapes
from wrinkles.normal_maps.pair_files import read_map
from wrinkles.normal_maps.spaces import encode_png

RNG = np.random.default_rng(12)
MEMORY = 100_000_000
"""Bytes at most, for files of some kilobytes."""

MESH = Mesh(
    RNG.random((6, 3), np.float32),
    np.array([[0, 1, 2], [0, 2, 3], [1, 4, 5]], np.int32),
    RNG.random((3, 3, 2), np.float32),
)
JOINTS = 24
NAMES = tuple(f"joint{joint}" for joint in range(JOINTS))
PARENTS = np.array([-1, *range(JOINTS - 1)], np.int32)
BODY = Body(
    Mesh(MESH.vertices, MESH.faces),
    shape_directions=(0.01 * RNG.standard_normal((2, 6, 3))).astype(np.float32),
    joints=RNG.random((JOINTS, 3), np.float32),
    joint_directions=(0.01 * RNG.standard_normal((2, JOINTS, 3))).astype(np.float32),
    joint_names=NAMES,
    parents=PARENTS,
    skin_weights=RNG.dirichlet(np.ones(JOINTS), 6).astype(np.float32),
)
POSES = PoseSequence(
    np.tile(np.eye(3, dtype=np.float32), (3, JOINTS, 1, 1)),
    RNG.random((3, 3), np.float32),
    np.zeros(2, np.float32),
    np.arange(3, dtype=np.int32),
    60.0,
    NAMES,
)
GARMENT = Garment(
    MESH,
    {"hem": np.array([0, 1, 2], np.int32)},
    np.array([0, 1, 2, 0, 1, 2], np.int32),
    RNG.dirichlet(np.ones(3), 6).astype(np.float32),
    BODY.skin_weights,
    np.zeros(2, np.float32),
)
RIG = Rig(
    ("left", "right"),
    np.tile(np.array([[900.0, 0, 320], [0, 900, 240], [0, 0, 1]]), (2, 1, 1)),
    np.zeros((2, 5)),
    np.tile(np.eye(4), (2, 1, 1)),
    np.array([[640, 480], [640, 480]], np.int32),
)
SMPL = {
    "v_template": RNG.normal(size=(6, 3)),
    "shapedirs": RNG.normal(size=(6, 3, 4)),
    "posedirs": RNG.normal(size=(6, 3, 9 * (JOINTS - 1))),
    "J_regressor": RNG.dirichlet(np.ones(6), JOINTS),
    "weights": RNG.dirichlet(np.ones(JOINTS), 6),
    "kintree_table": np.stack([np.concatenate([[2**32 - 1], np.arange(JOINTS - 1)]), np.arange(JOINTS)]),
    "f": MESH.faces,
}


@dataclass(frozen=True)
class Kind:
    """How a file is made in an empty folder, and how it is read there."""

    name: str
    make: Callable[[Path], Any]
    read: Callable[[Path], Any]


def textured_glb(path: Path) -> None:
    import trimesh

    model: Any = trimesh.Trimesh(MESH.vertices, MESH.faces, process=False)
    picture = Image.fromarray(RNG.integers(0, 256, (4, 4, 3), np.uint8))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=picture)
    model.visual = trimesh.visual.TextureVisuals(RNG.random((6, 2)), material=material)
    data = trimesh.Scene(model).export(file_type="glb")
    assert isinstance(data, bytes)
    path.write_bytes(data)


def text_ply(path: Path) -> None:
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    colours = "property uchar red\nproperty uchar green\nproperty uchar blue\n"
    faces = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    path.write_text(f"{head}{colours}{faces}0 0 0 1 2 3\n1 0 0 4 5 6\n1 1 0 7 8 9\n3 0 1 2\n")


def picture_of(kind: str) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        stream = io.BytesIO()
        Image.fromarray(RNG.integers(0, 256, (4, 4, 3), np.uint8)).save(stream, kind)
        path.write_bytes(stream.getvalue())
        materials(path.with_name("mesh.mtl"), path.name)

    return make


def materials(path: Path, picture: str = "skin.png") -> None:
    path.write_text(f"newmtl skin\nmap_Kd {picture}\n")
    if not (path.parent / picture).exists():
        Image.fromarray(RNG.integers(0, 256, (4, 4, 3), np.uint8)).save(path.parent / picture)
    path.with_name("mesh.obj").write_text(
        "mtllib mesh.mtl\nusemtl skin\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"
    )


def beside(path: Path) -> Any:
    return read_coloured_mesh(path.with_name("mesh.obj"))


def smpl_npz(path: Path) -> None:
    np.savez(path, allow_pickle=False, **SMPL)


def transforms(path: Path) -> None:
    frames = [{"file_path": f"{name}.png", "transform_matrix": np.eye(4).tolist()} for name in RIG.names]
    write_json(path, {"w": 64, "h": 48, "fl_x": 50.0, "cx": 32.5, "k1": 0.01, "frames": frames})


def metashape(path: Path) -> None:
    lens = "<resolution width='64' height='48'/><f>50</f><cx>0.5</cx><k1>0.01</k1><p1>1e-4</p1>"
    sensor = f"<sensor id='0' type='frame'><calibration>{lens}</calibration></sensor>"
    place = f"<transform>{' '.join(map(str, np.eye(4).ravel()))}</transform>"
    camera = f"<camera id='0' sensor_id='0' label='front'>{place}</camera>"
    path.write_text(
        f"<document><chunk><sensors>{sensor}</sensors><cameras>{camera}</cameras>"
        "<transform><scale>2.5</scale></transform></chunk></document>"
    )


def colmap(text: bool) -> Callable[[Path], None]:
    return lambda path: write_model(path.parent, RIG, text=text)


def capture(path: Path) -> None:
    write_capture_description(Capture(path.parent, "take", 60.0, (1, 2), (1, 2, 3), {"hem": (4, 5, 6)}))


def the_capture(path: Path) -> Capture:
    return Capture(path.parents[1], "take", 60.0, (1, 2), None)


def body_motion(path: Path) -> Any:
    return read_motion(path, BODY)


def other_bvh(path: Path) -> None:
    """Joints that are called as CMU calls them."""
    names = ("Hips", "LowerBack", "Spine", "Neck", "Head", "LeftArm", "LeftForeArm", "LeftHand")
    rotations = np.tile(np.eye(3), (2 * len(names), 1, 1))
    parents, offsets = np.array([-1, *range(len(names) - 1)]), RNG.random((len(names), 3))
    from scipy.spatial.transform import Rotation

    places = moved_by_root(offsets, np.zeros((2, 3)))
    motion = Bvh(path, names, parents, offsets, Rotation.from_matrix(rotations), places, 0.01)
    path.write_text(format_bvh(motion, np.ones((len(names), 3))))


def blendshapes(path: Path) -> None:
    basis = RNG.random((2, 6, 3), np.float32)
    model = BlendshapeModel(GARMENT, MESH.vertices, basis, np.ones(2, np.float32), NAMES, 60.0, "none")
    save_blendshapes(path, model)


def normal_map(path: Path) -> None:
    path.write_bytes(encode_png(RNG.random((4, 4, 3)) - 0.5, RNG.random((4, 4)) < 0.5))


def read_sequence(path: Path) -> Any:
    sequence = open_sequence(path)
    return [sequence.read(frame_id) for frame_id in sequence.frame_ids]


def write_scan_garment(path: Path) -> None:
    points = RNG.random((4, 3), np.float32)
    save_garment_scan(path, GarmentScan(MESH, points, np.zeros(4, np.int32), ("hem",), 1))


KINDS = [
    Kind("mesh.obj", lambda path: write_mesh(path, MESH, polygon_sizes=np.array([4, 3], np.int32)), read_coloured_mesh),
    Kind("mesh.ply", lambda path: write_mesh(path, MESH, colours=np.zeros((6, 3), np.uint8)), read_coloured_mesh),
    Kind("polygons.ply", lambda path: write_mesh(path, MESH, polygon_sizes=np.array([4, 3], np.int32)),
         read_coloured_mesh),
    Kind("text.ply", text_ply, read_coloured_mesh),
    Kind("mesh.glb", lambda path: write_mesh(path, MESH, colours=np.zeros((6, 3), np.uint8)), read_coloured_mesh),
    Kind("textured.glb", textured_glb, read_coloured_mesh),
    Kind("mesh.mtl", materials, beside),
    Kind("skin.png", picture_of("png"), beside),
    Kind("skin.jpg", picture_of("jpeg"), beside),
    Kind("skin.tif", picture_of("tiff"), beside),
    Kind("body.npz", lambda path: save_body(path, BODY), load_body),
    Kind("garment.npz", lambda path: save_garment(path, GARMENT), load_garment),
    Kind("poses.npz", lambda path: save_poses(path, POSES), load_poses),
    Kind("motion.npz", lambda path: save_poses(path, POSES), body_motion),
    Kind("amass.npz", lambda path: write_amass(path, SMPL_BODY, SMPL_POSES), lambda path: read_motion(path, SMPL_BODY)),
    Kind("motion.bvh", lambda path: write_bvh(path, BODY, POSES), body_motion),
    Kind("other.bvh", other_bvh, lambda path: read_motion(path, SMPL_BODY)),
    Kind("smpl.npz", smpl_npz, read_smpl),
    Kind("smpl.pkl", lambda path: path.write_bytes(pickle.dumps(SMPL, protocol=2)), read_smpl),
    Kind("text.pkl", lambda path: path.write_bytes(pickle.dumps(SMPL, protocol=0)), read_smpl),
    Kind("rig.json", lambda path: save_rig(path, RIG), load_rig),
    Kind("transforms.json", transforms, read_transforms),
    Kind("cameras.xml", metashape, read_metashape),
    Kind("any.json", lambda path: write_json(path, {"a": [1, 2.5, None], "b": {"c": "d"}}), read_json),
    Kind("rows.jsonl", lambda path: write_json_lines(path, [{"a": 1}, {"a": 2.5}]), read_json_lines),
    Kind("capture.json", capture, lambda path: read_capture(path.parent, scans=False)),
    Kind("cameras.bin", colmap(text=False), lambda path: read_model(path.parent)),
    Kind("images.bin", colmap(text=False), lambda path: read_model(path.parent)),
    Kind("frames.bin", colmap(text=False), lambda path: read_model(path.parent)),
    Kind("cameras.txt", colmap(text=True), lambda path: read_model(path.parent)),
    Kind("images.txt", colmap(text=True), lambda path: read_model(path.parent)),
    Kind("frames.txt", colmap(text=True), lambda path: read_model(path.parent)),
    Kind("blendshapes.safetensors", blendshapes, load_blendshapes),
    Kind("any.safetensors", lambda path: write_tensors(path, "test", {"a": np.ones((2, 3), np.float32)}, {"b": [1]}),
         lambda path: read_tensors(path, "test").entry("b")),
    Kind("truth/model.npz",
         lambda path: write_truth_model(path, TruthModel(MESH, GARMENT.loops, np.zeros(4, np.int32),
                                                         np.zeros((4, 3), np.float32))),
         lambda path: read_truth_model(the_capture(path))),
    Kind("truth/000001.npz",
         lambda path: write_truth_frame(path, TruthFrame(MESH.vertices, POSES.rotations[0], POSES.translations[0],
                                                         np.zeros(5, np.uint8))),
         lambda path: read_truth_frame(the_capture(path), 1)),
    Kind("scan.npz", write_scan_garment, lambda path: load_garment_scan(path, 1)),
    Kind("sequence.npz",
         lambda path: write_npz(path, vertices=RNG.random((2, 6, 3)), faces=MESH.faces), read_sequence),
    Kind("vertices.npy", lambda path: write_npy(path, RNG.random((4, 6, 3), np.float32)), map_array),
    Kind("map.png", normal_map, read_map),
]  # fmt: skip
BY_NAME = {kind.name: kind for kind in KINDS}


def smpl_body() -> tuple[Body, PoseSequence]:
    """SMPL's joints, where retargeting looks for them."""
    from capture4d.body.smpl import SMPL_JOINTS
    from capture4d.motions.retargeting import SMPL_TREE

    parents = [*(parent for parent, _ in SMPL_TREE.values()), 20, 21]
    offsets = [*(offset for _, offset in SMPL_TREE.values()), (0.08, 0, 0), (-0.08, 0, 0)]
    joints = np.zeros((JOINTS, 3), np.float32)
    for joint, (parent, offset) in enumerate(zip(parents, offsets, strict=True)):
        joints[joint] = np.array(offset) + (joints[parent] if parent >= 0 else 0)
    body = Body(
        Mesh(MESH.vertices, MESH.faces),
        shape_directions=BODY.shape_directions,
        joints=joints,
        joint_directions=BODY.joint_directions,
        joint_names=tuple(SMPL_JOINTS),
        parents=np.array(parents, np.int32),
        skin_weights=BODY.skin_weights,
    )
    poses = PoseSequence(
        POSES.rotations, POSES.translations, POSES.shape, POSES.frame_ids, POSES.fps, tuple(SMPL_JOINTS)
    )
    return body, poses


SMPL_BODY, SMPL_POSES = smpl_body()


@lru_cache
def whole(name: str) -> dict[str, bytes]:
    """A file of a kind, and what lies beside it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.parent.mkdir(exist_ok=True)
        BY_NAME[name].make(path)
        files = (file for file in Path(folder).rglob("*") if file.is_file())
        return {file.relative_to(folder).as_posix(): file.read_bytes() for file in files}


@contextlib.contextmanager
def laid_out(files: dict[str, bytes], name: str) -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        for file, data in files.items():
            (Path(folder) / file).parent.mkdir(exist_ok=True)
            (Path(folder) / file).write_bytes(data)
        yield Path(folder) / name


def value_or_one_line(kind: Kind, files: dict[str, bytes]) -> str:
    """Read a file; what is said of it, nothing if it has a value."""
    fault = None
    with laid_out(files, kind.name) as path:
        tracemalloc.start()
        try:
            kind.read(path)
        except InputError as error:
            fault = error
        finally:
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
    assert peak < MEMORY
    if fault is None:
        return ""
    assert fault.where is not None, fault
    assert Path(fault.where).is_relative_to(path.parents[1] if path.parent.name == "truth" else path.parent)
    assert "\n" not in str(fault)
    assert len(fault.reason) < 2000
    return str(fault)


@pytest.mark.parametrize("name", BY_NAME)
def test_a_whole_file_has_a_value(name: str) -> None:
    if name != "other.bvh":  # which lacks most joints
        assert value_or_one_line(BY_NAME[name], whole(name)) == ""


@pytest.mark.parametrize("name", BY_NAME)
def test_a_missing_file_is_named(name: str) -> None:
    files = {file: data for file, data in whole(name).items() if file != name}
    said = value_or_one_line(BY_NAME[name], files)
    optional = name in ("truth/model.npz", "frames.bin", "frames.txt")
    assert (said == "") if optional else ("no such" in said or "found nothing" in said or "found none" in said)


PLACE = st.floats(0, 1, exclude_max=True)
NUMBERS = st.sampled_from(
    [b"-1", b"0", b"1", b"3", b"255", b"-2147483649", b"4294967296", b"99999999999999999999", b"1e999", b"1e39", b"nan",
     b"1.5", b"", b"x", b"null", b"[]", b"{}", b'"1"', b"[[1, 2], [3]]", b"true", b"9" * 5000]
)  # fmt: skip
WORDS = st.sampled_from(
    [struct.pack(form, value) for form, value in (
        ("<I", 0), ("<I", 0xFFFFFFFF), ("<I", 0x7FFFFFFF), ("<i", -3), ("<Q", 2**62), ("<Q", 2**64 - 1), ("<f", np.nan),
        ("<f", np.inf), ("<f", 1e30), ("<d", np.nan), ("<d", 1e300), ("<H", 0xFFFF), ("<B", 0x80), (">I", 2**31),
    )]
)  # fmt: skip
DAMAGE = st.one_of(
    st.tuples(st.just("flip"), PLACE, st.integers(0, 7)),
    st.tuples(st.just("cut"), PLACE, st.integers(1, 40)),
    st.tuples(st.just("end"), PLACE, st.none()),
    st.tuples(st.just("insert"), PLACE, st.binary(min_size=1, max_size=6)),
    st.tuples(st.just("number"), PLACE, NUMBERS),
    st.tuples(st.just("word"), PLACE, WORDS),
    st.tuples(st.just("line"), PLACE, st.sampled_from(["twice", "gone"])),
)


def damaged(data: bytes, how: str, place: float, with_what: Any) -> bytes:
    at = int(place * len(data))
    match how:
        case "flip" if data:
            return data[:at] + bytes([data[at] ^ (1 << with_what)]) + data[at + 1 :]
        case "cut":
            return data[:at] + data[at + with_what :]
        case "end":
            return data[:at]
        case "insert":
            return data[:at] + with_what + data[at:]
        case "number":
            found = list(re.finditer(rb"-?\d+(\.\d+)?(e[+-]?\d+)?", data))
            if not found:
                return data
            chosen = found[int(place * len(found))]
            return data[: chosen.start()] + with_what + data[chosen.end() :]
        case "word":
            return data[:at] + with_what + data[at + len(with_what) :]
        case "line":
            lines = data.splitlines(keepends=True) or [b""]
            row = int(place * len(lines))
            return b"".join(lines[:row] + lines[row : row + 1] * (2 if with_what == "twice" else 0) + lines[row + 1 :])
    return data


@pytest.mark.parametrize("name", BY_NAME)
@given(damages=st.lists(DAMAGE, min_size=1, max_size=3))
@settings(max_examples=60, deadline=None)
def test_a_damaged_file_has_a_value_or_is_named(name: str, damages: list[tuple[str, float, Any]]) -> None:
    data = whole(name)[name]
    for damage in damages:
        data = damaged(data, *damage)
    value_or_one_line(BY_NAME[name], whole(name) | {name: data})


ARCHIVES = [name for name in BY_NAME if name.endswith(".npz")]
CHANGES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "number": lambda _: np.zeros(()),
    "nothing": lambda array: np.zeros(0, array.dtype),
    "no rows": lambda array: array[:0] if array.ndim else array,
    "doubles": lambda array: array.astype(np.float64) if array.dtype.kind in "biuf" else np.zeros(array.shape),
    "bytes": lambda array: np.zeros(array.shape, np.uint8),
    "words": lambda array: np.full(array.shape, "x"),
    "complex": lambda array: np.zeros(array.shape, np.complex128),
    "booleans": lambda array: np.zeros(array.shape, bool),
    "NaN": lambda array: np.full_like(array, np.nan) if array.dtype.kind == "f" else array,
    "infinite": lambda array: np.full_like(array, np.inf) if array.dtype.kind == "f" else array,
    "very large": lambda array: np.full(array.shape, 1e300) if array.dtype.kind == "f" else array,
    "large floats": lambda array: np.full(array.shape, 3e38, np.float32) if array.dtype.kind == "f" else array,
    "zeros": lambda array: np.zeros_like(array),
    "negative": lambda array: np.full_like(array, -7) if array.dtype.kind in "if" else array,
    "largest": lambda array: np.full_like(array, np.iinfo(array.dtype).max) if array.dtype.kind in "iu" else array,
    "an axis more": lambda array: array[None],
    "flat": lambda array: array.reshape(-1),
    "a row less": lambda array: array[:-1] if array.ndim else array,
    "turned": lambda array: array.T,
    "backwards": lambda array: array.astype(array.dtype.newbyteorder(">")),
    "objects": lambda array: np.full(array.shape, None),
}


@pytest.mark.parametrize("name", ARCHIVES)
def test_arrays_of_another_kind_have_a_value_or_are_named(name: str) -> None:
    with np.load(io.BytesIO(whole(name)[name]), allow_pickle=False) as archive:
        arrays = dict(archive)
    changes = list(CHANGES.values())
    for row, changed in enumerate(arrays):
        for change in (*changes[row % 4 :: 4], None):
            others = {key: value for key, value in arrays.items() if key != changed}
            stream = io.BytesIO()
            np.savez(stream, **others, **({} if change is None else {changed: change(arrays[changed])}))
            value_or_one_line(BY_NAME[name], whole(name) | {name: stream.getvalue()})


@pytest.mark.parametrize("name", ["rig.json", "transforms.json", "any.json", "rows.jsonl", "capture.json"])
@given(
    value=st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
        lambda inner: (
            st.lists(inner, max_size=3)
            | st.dictionaries(
                st.sampled_from(
                    [
                        "cameras",
                        "name",
                        "intrinsics",
                        "distortion",
                        "T_camera_world",
                        "width",
                        "height",
                        "format",
                        "fps",
                        "frames",
                        "file_path",
                        "transform_matrix",
                        "w",
                        "h",
                        "fl_x",
                        "units",
                        "garment_colour",
                        "boundary_colours",
                        "x",
                    ]
                ),
                inner,
                max_size=6,
            )
        ),
        max_leaves=20,
    )
)
@settings(max_examples=150, deadline=None)
def test_json_of_any_shape_has_a_value_or_is_named(name: str, value: Any) -> None:
    import json

    value_or_one_line(BY_NAME[name], whole(name) | {name: json.dumps(value).encode()})


def test_json_of_any_depth_is_named() -> None:
    for name in ("rig.json", "transforms.json", "any.json", "rows.jsonl", "capture.json"):
        for text in (b"[" * 100_000, b'{"a":' * 100_000 + b"1" + b"}" * 100_000):
            assert "not valid JSON" in value_or_one_line(BY_NAME[name], whole(name) | {name: text})
