"""A mesh that moves as a binary glTF file: morph targets and a skeleton whose weights and joints are animated.

What two clients agree on. A vertex has at most four influences, for three.js reads no more; target weights lie between
0 and 1, for Blender clamps shape keys; the base normals are weighted by angle, as Blender's are, which takes no normals
of targets, and the targets' normals are for the others. Time begins at 0. No tangents: they would be stale in every
frame but one.

References: glTF 2.0 specification, sections 3.7 (meshes, skins) and 3.11 (animations).
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Int32

from capture4d.files.atomic import write_chunks
from capture4d.mesh_files.animated.moving_mesh import CLOTH_COLOUR
from capture4d.types import Mesh

__all__ = ["AnimatedScene", "SceneSkin", "SceneTargets", "write_animated_glb"]

_TYPES = {"f4": 5126, "u4": 5125, "u2": 5123, "u1": 5121}
_ARRAY, _INDICES = 34962, 34963
_LINEAR, _MIPMAPS, _CLAMP = 9729, 9987, 33071


@dataclass(frozen=True, slots=True, eq=False)
class SceneTargets:
    """A base shape and what is added to it. T frames, V vertices, K targets."""

    base: Float32[np.ndarray, "verts 3"]
    base_normals: Float32[np.ndarray, "verts 3"]
    directions: Float32[np.ndarray, "targets verts 3"]
    normal_directions: Float32[np.ndarray, "targets verts 3"]
    weights: Float32[np.ndarray, "frames targets"]
    """Between 0 and 1."""
    names: Sequence[str]


@dataclass(frozen=True, slots=True, eq=False)
class SceneSkin:
    """A skeleton, and how the vertices hang from it. J joints, the root first, parents before children."""

    names: Sequence[str]
    parents: Sequence[int]
    """-1 for the root."""
    rest: Float32[np.ndarray, "joints 3"]
    """Joints in the rest pose, metres."""
    quaternions: Float32[np.ndarray, "frames joints 4"]
    """x y z w, relative to the parent; one frame's in the same half of the sphere as the one before."""
    root_places: Float32[np.ndarray, "frames 3"]
    joints: Int32[np.ndarray, "verts 4"]
    weights: Float32[np.ndarray, "verts 4"]


@dataclass(frozen=True, slots=True, eq=False)
class AnimatedScene:
    """What is written."""

    mesh: Mesh
    """Faces and UVs, V pointing up."""
    times_s: Float32[np.ndarray, " frames"]
    """From 0 on."""
    targets: SceneTargets
    skin: SceneSkin | None = None
    normal_map: bytes | None = None
    """A PNG, +Y."""
    base_colours: bytes | None = None
    """A PNG, sRGB."""
    asset_extras: Mapping[str, Any] = field(default_factory=dict)
    scene_extras: Mapping[str, Any] = field(default_factory=dict)
    name: str = "garment"
    """Of node, mesh and material."""
    colour: tuple[float, float, float] = CLOTH_COLOUR
    """Linear; seen where there are no base colours."""


class _Buffer:
    """The binary chunk, as it grows, and what is told of it."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.size = 0
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, data: bytes, target: int | None = None) -> int:
        entry: dict[str, Any] = {"buffer": 0, "byteOffset": self.size, "byteLength": len(data)}
        self.views.append(entry if target is None else {**entry, "target": target})
        self.parts.append(data + b"\0" * (-len(data) % 4))
        self.size += len(self.parts[-1])
        return len(self.views) - 1

    def add(self, values: np.ndarray, kind: str, *, target: int | None = None, ends: bool = False) -> int:
        """An accessor of rows.

        Args:
            kind: such as "VEC3".
            ends: whether its least and largest values are told.
        """
        view = self.view(np.ascontiguousarray(values).tobytes(), target)
        entry: dict[str, Any] = {"bufferView": view, "componentType": _TYPES[values.dtype.str[1:]]}
        entry |= {"count": len(values), "type": kind}
        if ends:
            flat = values.reshape(len(values), -1)
            entry |= {"min": flat.min(axis=0).tolist(), "max": flat.max(axis=0).tolist()}
        self.accessors.append(entry)
        return len(self.accessors) - 1


def write_animated_glb(path: Path, scene: AnimatedScene) -> None:
    """Write a .glb file, atomically. Vertices are split along UV seams; `_VERTEX` is the number each had before."""
    buffer = _Buffer()
    vertex, mesh = _mesh(buffer, scene)
    tree: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "capture4d", "extras": dict(scene.asset_extras)},
        "scene": 0,
        "nodes": [{"name": scene.name, "mesh": 0}],
        "meshes": [mesh],
        **_material(buffer, scene),
    }
    channels: list[dict[str, Any]] = []
    samplers: list[dict[str, Any]] = []
    time = buffer.add(scene.times_s.astype("<f4"), "SCALAR", ends=True)

    def animate(node: int, what: str, values: np.ndarray, kind: str) -> None:
        samplers.append({"input": time, "output": buffer.add(values.astype("<f4"), kind), "interpolation": "LINEAR"})
        channels.append({"sampler": len(samplers) - 1, "target": {"node": node, "path": what}})

    if len(scene.targets.directions):
        animate(0, "weights", scene.targets.weights.reshape(-1), "SCALAR")
    roots = [0]
    if scene.skin is not None:
        roots.append(1)
        tree["nodes"] += _joints(scene.skin)
        tree["nodes"][0]["skin"] = 0
        tree["skins"] = [_skin(buffer, scene.skin)]
        mesh["primitives"][0]["attributes"] |= _influences(buffer, scene.skin, vertex)
        animate(1, "translation", scene.skin.root_places, "VEC3")
        for joint in range(len(scene.skin.names)):
            animate(1 + joint, "rotation", scene.skin.quaternions[:, joint], "VEC4")
    tree["scenes"] = [{"nodes": roots, "extras": dict(scene.scene_extras)}]
    if channels:
        tree["animations"] = [{"name": "take", "samplers": samplers, "channels": channels}]
    tree |= {"accessors": buffer.accessors, "bufferViews": buffer.views, "buffers": [{"byteLength": buffer.size}]}
    text = json.dumps(tree, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + buffer.size)
    head += struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", buffer.size, b"BIN\0")
    write_chunks(path, [head, *buffer.parts])


def _mesh(buffer: _Buffer, scene: AnimatedScene) -> tuple[np.ndarray, dict[str, Any]]:
    """The number of each split vertex before it was split, and the mesh."""
    faces, uv, targets = scene.mesh.faces, scene.mesh.uv, scene.targets
    attributes: dict[str, int] = {}
    if uv is None:
        vertex, corners = np.arange(len(targets.base)), faces
    else:
        keys = np.column_stack([faces.reshape(-1).astype(np.float64), uv.reshape(-1, 2)])
        rows, corners = np.unique(keys, axis=0, return_inverse=True)
        vertex = rows[:, 0].astype(np.int64)
        downwards = np.column_stack([rows[:, 1], 1 - rows[:, 2]]).astype("<f4")
        attributes["TEXCOORD_0"] = buffer.add(downwards, "VEC2", target=_ARRAY)

    def at_vertices(values: np.ndarray, *, ends: bool = False) -> int:
        return buffer.add(values[vertex].astype("<f4"), "VEC3", target=_ARRAY, ends=ends)

    attributes["POSITION"] = at_vertices(targets.base, ends=True)
    attributes["NORMAL"] = at_vertices(targets.base_normals)
    attributes["_VERTEX"] = buffer.add(vertex.astype("<f4"), "SCALAR", target=_ARRAY)
    index = buffer.add(corners.reshape(-1).astype("<u4"), "SCALAR", target=_INDICES)
    primitive: dict[str, Any] = {"attributes": attributes, "indices": index, "material": 0}
    mesh: dict[str, Any] = {"name": scene.name, "primitives": [primitive]}
    if len(targets.directions):
        primitive["targets"] = [
            {"POSITION": at_vertices(places, ends=True), "NORMAL": at_vertices(normals)}
            for places, normals in zip(targets.directions, targets.normal_directions, strict=True)
        ]
        mesh["weights"] = targets.weights[0].tolist()
        mesh["extras"] = {"targetNames": list(targets.names)}
    return vertex, mesh


def _material(buffer: _Buffer, scene: AnimatedScene) -> dict[str, Any]:
    surface: dict[str, Any] = {
        "baseColorFactor": [*scene.colour, 1.0],
        "metallicFactor": 0.0,
        "roughnessFactor": 0.85,
    }
    material: dict[str, Any] = {"name": scene.name, "doubleSided": True, "pbrMetallicRoughness": surface}
    images: list[dict[str, Any]] = []
    for name, picture in (("normal", scene.normal_map), ("albedo", scene.base_colours)):
        if picture is None:
            continue
        if name == "normal":
            material["normalTexture"] = {"index": len(images)}
        else:
            surface |= {"baseColorTexture": {"index": len(images)}, "baseColorFactor": [1.0, 1.0, 1.0, 1.0]}
        images.append({"bufferView": buffer.view(picture), "mimeType": "image/png", "name": name})
    if not images:
        return {"materials": [material]}
    return {
        "materials": [material],
        "textures": [{"source": each, "sampler": 0} for each in range(len(images))],
        "samplers": [{"magFilter": _LINEAR, "minFilter": _MIPMAPS, "wrapS": _CLAMP, "wrapT": _CLAMP}],
        "images": images,
    }


def _joints(skin: SceneSkin) -> list[dict[str, Any]]:
    """A node for each; the first is number 1 of the file."""
    nodes: list[dict[str, Any]] = []
    for joint, (name, parent) in enumerate(zip(skin.names, skin.parents, strict=True)):
        place = skin.rest[joint] - (skin.rest[parent] if parent >= 0 else 0)
        nodes.append({"name": name, "translation": place.tolist()})
        if parent >= 0:
            nodes[parent].setdefault("children", []).append(1 + joint)
    return nodes


def _skin(buffer: _Buffer, skin: SceneSkin) -> dict[str, Any]:
    inverse = np.tile(np.eye(4, dtype="<f4"), (len(skin.rest), 1, 1))
    inverse[:, 3, :3] = -skin.rest  # columns first
    matrices = buffer.add(inverse.reshape(-1, 16), "MAT4")
    return {"joints": [1 + each for each in range(len(skin.rest))], "inverseBindMatrices": matrices, "skeleton": 1}


def _influences(buffer: _Buffer, skin: SceneSkin, vertex: np.ndarray) -> dict[str, int]:
    kind = "<u1" if len(skin.rest) <= 256 else "<u2"
    return {
        "JOINTS_0": buffer.add(skin.joints[vertex].astype(kind), "VEC4", target=_ARRAY),
        "WEIGHTS_0": buffer.add(skin.weights[vertex].astype("<f4"), "VEC4", target=_ARRAY),
    }
