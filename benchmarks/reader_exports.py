"""Small files as other programs export them: what the kinds of `benchmarks.reader_kinds` write."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import Image

from benchmarks.reader_values import MESH, RIG, RNG, SMPL_BODY
from capture4d.cameras.exchange import read_foreign_rig
from capture4d.files.records import load_rig, save_rig
from capture4d.mesh_files.gltf.compression import DRACO, MESHOPT
from capture4d.mesh_files.meshes import read_coloured_mesh, write_mesh
from capture4d.motions.motion_files import read_motion
from capture4d.motions.retargeting import SMPL_TREE
from capture4d.types import Rig

__all__ = ["BESIDE", "EXPORTS"]

FRAMES = 3


# --- meshes ----------------------------------------------------------------------------------------------------------


def _picture(path: Path) -> None:
    Image.fromarray(RNG.integers(0, 256, (4, 4, 3), np.uint8)).save(path)


def _stl(path: Path) -> None:
    corners = MESH.vertices[MESH.faces]
    rows = b"".join(struct.pack("<12fH", 0, 0, 0, *face.ravel(), 0x7FFF) for face in corners)
    path.write_bytes(b"a scan".ljust(80) + struct.pack("<I", len(corners)) + rows)


def _text_stl(path: Path) -> None:
    lines = []
    for face in MESH.vertices[MESH.faces]:
        corners = "\n".join("      vertex " + " ".join(f"{value:.6e}" for value in corner) for corner in face)
        lines.append(f"  facet normal 0 0 1\n    outer loop\n{corners}\n    endloop\n  endfacet\n")
    path.write_text(f"solid scan\n{''.join(lines)}endsolid scan\n")


def _off(path: Path) -> None:
    vertices = "".join("{:.6f} {:.6f} {:.6f} 10 20 30 255\n".format(*vertex) for vertex in MESH.vertices)
    faces = "".join("3 {} {} {}\n".format(*face) for face in MESH.faces)
    path.write_text(f"COFF\n# a scan\n{len(MESH.vertices)} {len(MESH.faces)} 0\n{vertices}{faces}")


def _two_materials(path: Path) -> None:
    """An obj with a texture of its own for each of two materials; `path` is it, or its mtl."""
    for name in ("first.png", "second.png"):
        _picture(path.with_name(name))
    path.with_name("two.mtl").write_text(
        "newmtl first\nKd 1 1 1\nmap_Kd first.png\nnewmtl second\nKd 0.5 0.5 0.5\nmap_Kd -s 1 1 1 second.png\n"
    )
    path.with_name("two.obj").write_text(
        "mtllib two.mtl\no scan\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nvt 1 1\nvn 0 0 1\n"
        "usemtl first\nf 1/1/1 2/2/1 3/3/1\nusemtl second\nf 2/2/1 4/4/1 \\\n3/3/1\n"
    )


def _pictured_ply(path: Path) -> None:
    """Faces with UVs and the number of their texture, as MeshLab writes them."""
    for name in ("first.png", "second.png"):
        _picture(path.with_name(name))
    head = "ply\nformat binary_little_endian 1.0\ncomment TextureFile first.png\ncomment TextureFile second.png\n"
    head += "element vertex 6\nproperty float x\nproperty float y\nproperty float z\nelement face 3\n"
    head += "property list uchar int vertex_indices\nproperty list uchar float texcoord\nproperty int texnumber\n"
    faces = [
        struct.pack("<B3iB6fi", 3, *face, 6, *uv.ravel(), number % 2)
        for number, (face, uv) in enumerate(zip(MESH.faces, np.asarray(MESH.uv), strict=True))
    ]
    path.write_bytes(f"{head}end_header\n".encode() + MESH.vertices.astype("<f4").tobytes() + b"".join(faces))


# --- glTF ------------------------------------------------------------------------------------------------------------


class _Scene:
    """The JSON of one mesh and its bytes, filled view by view."""

    def __init__(self) -> None:
        self.data = b""
        self.tree: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0, "translation": [0, 1, 0], "rotation": [0, 1, 0, 0]}],
            "meshes": [{"primitives": []}],
            "bufferViews": [],
            "accessors": [],
            "buffers": [],
        }

    def view(self, data: bytes, **more: Any) -> int:
        place = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)}
        self.data += data + b"\0" * (-len(data) % 4)
        self.tree["bufferViews"].append(place | more)
        return len(self.tree["bufferViews"]) - 1

    def accessor(self, count: int, component: int, kind: str, **more: Any) -> int:
        self.tree["accessors"].append({"componentType": component, "count": count, "type": kind} | more)
        return len(self.tree["accessors"]) - 1

    def mesh(self, attributes: Mapping[str, int], indices: int, **more: Any) -> None:
        self.tree["meshes"][0]["primitives"].append({"attributes": attributes, "indices": indices} | more)

    def write(self, path: Path, *, buffer: str | None = None) -> None:
        """As a glb, or as JSON with its bytes under a name beside it."""
        self.tree["buffers"].insert(0, {"byteLength": len(self.data)} | ({} if buffer is None else {"uri": buffer}))
        text = json.dumps(self.tree).encode()
        if buffer is not None:
            path.with_name(buffer).write_bytes(self.data)
            path.write_bytes(text)
            return
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(self.data), b"BIN\0")
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks + self.data)) + chunks + self.data)


_COUNT = len(MESH.vertices)
_BYTES = np.column_stack([RNG.integers(0, 256, (_COUNT, 3)), np.full(_COUNT, 255)]).astype(np.uint8)


def _beside_buffer(path: Path) -> None:
    """A scene.gltf and its scene.bin, with sparse values and quantised colours; `path` is one of the two."""
    scene = _Scene()
    base, changed = np.zeros_like(MESH.vertices), np.arange(1, _COUNT, dtype=np.uint16)
    sparse = {
        "count": len(changed),
        "indices": {"bufferView": scene.view(changed.tobytes()), "componentType": 5123},
        "values": {"bufferView": scene.view(MESH.vertices[changed].tobytes())},
    }
    places = scene.accessor(_COUNT, 5126, "VEC3", bufferView=scene.view(base.tobytes()), sparse=sparse)
    colours = scene.accessor(_COUNT, 5121, "VEC4", bufferView=scene.view(_BYTES.tobytes()), normalized=True)
    faces = scene.view(MESH.faces.astype(np.uint16).tobytes())
    scene.mesh({"POSITION": places, "COLOR_0": colours}, scene.accessor(MESH.faces.size, 5123, "SCALAR",
                                                                        bufferView=faces))  # fmt: skip
    scene.write(path.with_suffix(".gltf"), buffer="scene.bin")


def _draco(path: Path) -> None:
    import DracoPy

    payload = DracoPy.encode(MESH.vertices, MESH.faces.astype(np.uint32), colors=_BYTES, preserve_order=True)
    names = {0: "POSITION", 2: "COLOR_0"}
    ids = {names[each["attribute_type"]]: each["unique_id"] for each in DracoPy.decode(payload).attributes}
    scene = _Scene()
    packed = {DRACO: {"bufferView": scene.view(payload), "attributes": ids}}
    attributes = {
        "POSITION": scene.accessor(_COUNT, 5126, "VEC3"),
        "COLOR_0": scene.accessor(_COUNT, 5121, "VEC4", normalized=True),
    }
    scene.mesh(attributes, scene.accessor(MESH.faces.size, 5123, "SCALAR"), extensions=packed)
    scene.tree["extensionsUsed"] = scene.tree["extensionsRequired"] = [DRACO]
    scene.write(path)


def _meshopt(path: Path) -> None:
    """Quantised, and every view packed, as gltfpack -cc writes it."""
    import meshopt

    scene, length = _Scene(), 0

    def packed(rows: np.ndarray, mode: Literal["ATTRIBUTES", "TRIANGLES"], stride: int) -> int:
        nonlocal length
        data = meshopt.encode_gltf_buffer(rows, mode, 0)
        place = {"buffer": 0, "byteOffset": len(scene.data), "byteLength": len(data), "byteStride": stride}
        found = scene.view(data)
        count = len(rows)
        view: dict[str, Any] = {"buffer": 1, "byteOffset": length, "byteLength": count * stride}
        view |= {"byteStride": stride} if mode == "ATTRIBUTES" else {}
        scene.tree["bufferViews"][found] = view | {"extensions": {MESHOPT[0]: place | {"count": count, "mode": mode}}}
        length += -(-count * stride // 4) * 4
        return found

    places = np.rint(65535 * MESH.vertices).astype(np.uint16)
    rows = np.column_stack([places, places[:, :1]]).view(np.uint8).reshape(_COUNT, 8)
    at = scene.accessor(_COUNT, 5123, "VEC3", bufferView=packed(rows, "ATTRIBUTES", 8), normalized=True)
    colours = scene.accessor(_COUNT, 5121, "VEC4", bufferView=packed(_BYTES, "ATTRIBUTES", 4), normalized=True)
    faces = packed(MESH.faces.ravel().astype(np.uint16), "TRIANGLES", 2)
    scene.mesh({"POSITION": at, "COLOR_0": colours}, scene.accessor(MESH.faces.size, 5123, "SCALAR", bufferView=faces))
    scene.tree["buffers"].append({"byteLength": length, "extensions": {MESHOPT[0]: {"fallback": True}}})
    scene.tree["extensionsUsed"] = scene.tree["extensionsRequired"] = [MESHOPT[0], "KHR_mesh_quantization"]
    scene.write(path)


# --- motions ---------------------------------------------------------------------------------------------------------

_HUMANIK = {
    "pelvis": "Hips", "spine1": "Spine", "spine2": "Spine1", "spine3": "Spine2", "neck": "Neck", "head": "Head",
    "hip": "UpLeg", "knee": "Leg", "ankle": "Foot", "foot": "ToeBase", "collar": "Shoulder", "shoulder": "Arm",
    "elbow": "ForeArm", "wrist": "Hand",
}  # fmt: skip
_BIPED = {
    "pelvis": "Pelvis", "spine1": "Spine", "spine2": "Spine1", "spine3": "Spine2", "neck": "Neck", "head": "Head",
    "hip": "Thigh", "knee": "Calf", "ankle": "Foot", "foot": "Toe0", "collar": "Clavicle", "shoulder": "UpperArm",
    "elbow": "Forearm", "wrist": "Hand",
}  # fmt: skip


def _mixamo(part: str) -> str:
    side, _, limb = part.partition("_")
    return f"mixamorig:{side.title()}{_HUMANIK[limb]}" if limb else f"mixamorig:{_HUMANIK[part]}"


def _max(part: str) -> str:
    side, _, limb = part.partition("_")
    return f"Bip01 {side[0].upper()} {_BIPED[limb]}" if limb else f"Bip01 {_BIPED[part]}"


def _bvh(path: Path, *, called: Callable[[str], str], places: bool) -> None:
    """SMPL's joints under other names, in centimetres.

    Args:
        places: every joint has channels of its place, which stand instead of offsets of zero.
    """
    parts = list(SMPL_TREE)
    offsets = 100 * np.array([offset for _, offset in SMPL_TREE.values()])
    rows: list[list[float]] = [[] for _ in range(FRAMES)]

    def joint(number: int, indent: str) -> str:
        moved = places or number == 0
        offset = "0 0 0" if places else " ".join(f"{value:.4f}" for value in offsets[number])
        channels = (
            "6 Xposition Yposition Zposition Zrotation Xrotation Yrotation"
            if moved
            else "3 ZROTATION XROTATION YROTATION"
        )
        for frame, row in enumerate(rows):
            row += [*(offsets[number] + (frame if number == 0 else 0))] if moved else []
            row += [5.0 * frame, 0.0, float(number)]
        children = [child for child, (parent, _) in enumerate(SMPL_TREE.values()) if parent == number]
        inner = "".join(joint(child, indent + "\t") for child in children)
        inner = inner or f"{indent}\tEnd Site\n{indent}\t{{\n{indent}\t\tOFFSET 0 1 0\n{indent}\t}}\n"
        kind = "JOINT" if number else "ROOT"
        return (f"{indent}{kind} {called(parts[number])}\n{indent}{{\n{indent}\tOFFSET {offset}\n"
                f"{indent}\tCHANNELS {channels}\n{inner}{indent}}}\n")  # fmt: skip

    tree = joint(0, "")
    motion = "\n".join(" ".join(f"{value:.4f}" for value in row) for row in rows)
    path.write_text(f"HIERARCHY\n{tree}MOTION\n\nFrames: {FRAMES}\nFrame Time: 0.0333333\n{motion}\n")


def _parameters(path: Path) -> None:
    """As GVHMR and smplx call them, under Y up."""
    turns = {"global_orient": np.zeros((FRAMES, 3)), "body_pose": 0.1 * RNG.standard_normal((FRAMES, 63))}
    np.savez(path, **turns, transl=RNG.random((FRAMES, 3)), betas=np.zeros((FRAMES, 10)), fps=np.float64(30))


def _about_origin(path: Path) -> None:
    """As EasyMocap calls them, with matrices and an axis of one."""
    matrices = np.tile(np.eye(3), (FRAMES, 24, 1, 1))
    np.savez(path, poses=matrices[None], Rh=np.zeros((FRAMES, 1, 3)), Th=RNG.random((FRAMES, 3)), fps=np.array([30]))


# --- rigs ------------------------------------------------------------------------------------------------------------


def _fisheye(path: Path) -> None:
    bent = RIG.distortion + np.array([0.01, -0.02, 0.03, -0.04, 0])
    save_rig(path, Rig(RIG.names, RIG.intrinsics, bent, RIG.T_camera_world, RIG.image_sizes, ("fisheye", "brown")))


def _metashape(path: Path) -> None:
    def camera(number: int) -> str:
        place = " ".join(str(value) for value in (1, 0, 0, number, 0, 0, 1, 0.5, 0, -1, 0, 2, 0, 0, 0, 1))
        return (f'<camera id="{number}" sensor_id="0" component_id="0" label="pod {number}.JPG">'
                f"<transform>{place}</transform></camera>")  # fmt: skip

    path.write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="1.5.0"><chunk label="Chunk 1" enabled="true">\n'
        '<sensors next_id="1"><sensor id="0" label="unknown" type="frame"><resolution width="640" height="480"/>'
        '<calibration type="frame" class="adjusted"><resolution width="640" height="480"/><f>900</f><cx>3</cx>'
        "<cy>-2</cy><b1>0.5</b1><k1>0.01</k1><p1>0.001</p1></calibration></sensor></sensors>\n"
        '<components next_id="1"><component id="0" label="Component 1"><transform>'
        "<rotation>1 0 0 0 1 0 0 0 1</rotation><translation>1 2 3</translation><scale>0.25</scale>"
        "</transform></component></components>\n"
        f'<cameras next_id="2"><group id="0" label="a">{camera(0)}</group>{camera(1)}</cameras>\n</chunk></document>\n'
    )


def _transforms(path: Path) -> None:
    turn = [[1, 0, 0, 0], [0, 0, -1, 2], [0, 1, 0, 1], [0, 0, 0, 1]]
    frames: list[dict[str, Any]] = [
        {"file_path": f"images/{name}.png", "transform_matrix": turn} for name in ("a", "b")
    ]
    frames[1] |= {"camera_model": "OPENCV_FISHEYE", "k4": 0.01, "p1": 0, "p2": 0}
    lens = {"w": 640, "h": 480, "fl_x": 900.0, "fl_y": 901.0, "cx": 320.0, "cy": 240.0, "k1": 0.01, "p1": 0.001}
    applied = {"applied_transform": [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]], "applied_scale": 0.5}
    path.write_text(json.dumps({"camera_model": "OPENCV", **lens, **applied, "frames": frames}))


def _checkerboard(path: Path) -> None:
    squares = np.indices((4, 5)).sum(axis=0) % 2
    picture = np.pad(np.kron(squares, np.ones((8, 8), int)), 8, constant_values=1)
    Image.fromarray((200 * picture + 20).astype(np.uint8)).save(path)


def _seen(path: Path) -> Any:
    from capture4d.calibration.board_images import read_grey
    from capture4d.calibration.checkerboard import find_checkerboard
    from capture4d.cameras.board import parse_board
    from capture4d.files.reading import reading

    with reading(path, "image of a board"):
        return find_checkerboard(read_grey(path), parse_board("checkerboard:5x4:60"))


def _on_smpl(path: Path) -> Any:
    return read_motion(path, SMPL_BODY)


EXPORTS: dict[str, tuple[Callable[[Path], Any], Callable[[Path], Any]]] = {
    "binary.stl": (_stl, read_coloured_mesh),
    "text.stl": (_text_stl, read_coloured_mesh),
    "mesh.off": (_off, read_coloured_mesh),
    "written.off": (lambda path: write_mesh(path, MESH), read_coloured_mesh),
    "pictured.ply": (_pictured_ply, read_coloured_mesh),
    "two.obj": (_two_materials, read_coloured_mesh),
    "scene.gltf": (_beside_buffer, read_coloured_mesh),
    "draco.glb": (_draco, read_coloured_mesh),
    "meshopt.glb": (_meshopt, read_coloured_mesh),
    "mixamo.bvh": (partial(_bvh, called=_mixamo, places=False), _on_smpl),
    "biped.bvh": (partial(_bvh, called=_max, places=True), _on_smpl),
    "parameters.npz": (_parameters, _on_smpl),
    "about_origin.npz": (_about_origin, _on_smpl),
    "fisheye.json": (_fisheye, load_rig),
    "cameras.xml": (_metashape, lambda path: read_foreign_rig(path).rig),
    "transforms.json": (_transforms, lambda path: read_foreign_rig(path).rig),
    "checkerboard.png": (_checkerboard, _seen),
}
"""How a file of each kind is written, and read."""
BESIDE: dict[str, tuple[Callable[[Path], Any], Callable[[Path], Any]]] = {
    "two.mtl": (_two_materials, lambda path: read_coloured_mesh(path.with_suffix(".obj"))),
    "scene.bin": (_beside_buffer, lambda path: read_coloured_mesh(path.with_suffix(".gltf"))),
}
"""Those that are read with another file."""
