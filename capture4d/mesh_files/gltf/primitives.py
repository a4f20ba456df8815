"""The surfaces of a glTF scene: vertices and triangles in the world, and what else their vertices have."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32, Int32, Integer

from capture4d.errors import InputError
from capture4d.mesh_files.gltf.accessors import accessor_values, has_bytes, unpacked_values
from capture4d.mesh_files.gltf.compression import DRACO, Draco, draco_mesh
from capture4d.mesh_files.gltf.document import MOST, Document
from capture4d.mesh_files.gltf.entries import extension
from capture4d.mesh_files.gltf.poses import World, morphed, skinned
from capture4d.mesh_files.gltf.scene import PlacedNode, placed_nodes

__all__ = ["Primitive", "primitives"]

_TRIANGLES, _STRIP, _FAN = 4, 5, 6


@dataclass(frozen=True, slots=True, eq=False)
class Primitive:
    """One surface with one material, where its node puts it."""

    vertices: Float32[np.ndarray, "verts 3"]
    faces: Int32[np.ndarray, "faces 3"]
    material: Any
    """Its number, or None."""
    names: tuple[str, ...]
    """Of what its vertices have."""
    attribute: Callable[[str, tuple[int, ...]], np.ndarray]
    """One of these by name, of one of several widths, a row for each vertex."""


def primitives(document: Document) -> Iterator[Primitive]:
    """The surfaces of the scene, node by node.

    Raises:
        InputError: one of them is damaged, or there is more of them than a scan can have.
    """
    vertices = faces = 0
    placed = list(placed_nodes(document))
    world = {node.index: node.transform for node in placed}
    if not document.tree.get("nodes"):  # meshes that nothing places
        placed = [PlacedNode(-1, {"mesh": index}, np.eye(4), True) for index, _ in enumerate(_meshes(document))]
    for node in placed:
        if not node.visible or node.entry.get("mesh") is None:
            continue
        mesh = document.entry("meshes", node.entry["mesh"])
        for described in mesh.get("primitives", []):
            mode = described.get("mode", _TRIANGLES)
            if mode in (0, 1, 2, 3):  # points and lines
                continue
            if mode not in (_TRIANGLES, _STRIP, _FAN):
                raise InputError(f"mode: expected a kind of primitive from 0 to 6, found {str(mode)[:40]!r}")
            primitive = _primitive(document, mesh, described, node, world)
            vertices, faces = vertices + len(primitive.vertices), faces + len(primitive.faces)
            if max(vertices, faces) > MOST:
                raise InputError(f"expected a scene of at most {MOST} vertices and faces, found more")
            yield primitive


def _meshes(document: Document) -> list[Any]:
    meshes = document.tree.get("meshes", [])
    return meshes if isinstance(meshes, list) else []


def _primitive(
    document: Document, mesh: dict[str, Any], described: dict[str, Any], node: PlacedNode, world: World
) -> Primitive:
    attributes = described.get("attributes")
    if not isinstance(attributes, dict):
        raise InputError(f"expected attributes of a primitive, found {str(attributes)[:40]!r}")
    packed = _packed(document, described)

    def attribute(name: str, widths: tuple[int, ...]) -> np.ndarray:
        found = _attribute(document, described, packed, name)
        if found.shape[1] not in widths:
            raise InputError(f"{name}: expected {widths[0]} numbers a vertex, found {found.shape[1]}")
        if name != "POSITION" and len(found) != len(vertices):
            raise InputError(f"expected {name} of each of {len(vertices)} vertices, found {len(found)}")
        return found

    vertices = attribute("POSITION", (3,)).astype(np.float32)
    faces = _faces(document, described, packed, len(vertices))
    vertices = morphed(document, mesh, described, node.entry, vertices)
    if node.entry.get("skin") is not None and "JOINTS_0" in attributes:
        vertices, mirrored = skinned(document, node.entry["skin"], attribute, tuple(attributes), vertices, world)
    else:
        vertices, mirrored = _moved(vertices, node.transform)
    if mirrored:  # a mirrored surface keeps its outside
        faces = np.ascontiguousarray(faces[:, ::-1])
    return Primitive(vertices, faces, described.get("material"), tuple(attributes), attribute)


def _moved(vertices: Float32[np.ndarray, "verts 3"], transform: np.ndarray) -> tuple[np.ndarray, bool]:
    """Points in the world, and whether it is a mirror that put them there."""
    if np.array_equal(transform, np.eye(4)):
        return vertices, False
    moved = vertices.astype(np.float64) @ transform[:3, :3].T + transform[:3, 3]
    return moved.astype(np.float32), bool(np.linalg.det(transform[:3, :3]) < 0)


def _packed(document: Document, described: dict[str, Any]) -> tuple[Draco, dict[str, Any]] | None:
    """What Draco has of a primitive, and by which numbers."""
    found = extension(described, DRACO)
    if found is None:
        return None
    view, ids = found.get("bufferView"), found.get("attributes")
    if not isinstance(ids, dict):
        raise InputError(f"{DRACO}: expected attributes, found {str(ids)[:40]!r}")
    data = document.view(view)[0]
    if ("draco", view) not in document.kept:
        document.kept["draco", view] = draco_mesh(f"bufferViews[{view}]", bytes(data))
    return document.kept["draco", view], ids


def _attribute(
    document: Document, described: dict[str, Any], packed: tuple[Draco, dict[str, Any]] | None, name: str
) -> np.ndarray:
    index = described["attributes"].get(name)
    if packed is not None and name in packed[1]:
        values = packed[0].attributes.get(packed[1][name])
        if values is None or values.ndim != 2:
            raise InputError(f"{DRACO}: expected {name} as number {str(packed[1][name])[:40]}, found none")
        return unpacked_values(document, index, values) if index is not None else values
    if index is None:
        raise InputError(f"expected {name} in a primitive, found {', '.join(described['attributes']) or 'none'}")
    if name == "POSITION" and not has_bytes(document, index):
        elsewhere = ", ".join(described.get("extensions") or {})
        raise InputError(f"accessors[{index}]: expected a buffer view, found none{elsewhere and ' but ' + elsewhere}")
    return accessor_values(document, index)


def _faces(
    document: Document, described: dict[str, Any], packed: tuple[Draco, Any] | None, count: int
) -> Int32[np.ndarray, "faces 3"]:
    mode = _TRIANGLES if packed is not None else described.get("mode", _TRIANGLES)
    if packed is not None:
        corners = packed[0].faces.reshape(-1)
    elif described.get("indices") is not None:
        found = accessor_values(document, described["indices"])
        if found.dtype.kind != "u" or found.shape[1] != 1:
            raise InputError(f"indices: expected whole numbers, found {found.dtype} of shape {found.shape}")
        corners = found[:, 0].astype(np.int64)
    else:
        corners = np.arange(count)
    if len(corners) and (corners.max() >= count or corners.min() < 0):
        raise InputError(f"expected vertex indices from 0 to {count - 1}, found {corners.max()}")
    return _triangles(corners, mode).astype(np.int32)


def _triangles(corners: Integer[np.ndarray, " corners"], mode: int) -> Integer[np.ndarray, "faces 3"]:
    if mode == _TRIANGLES:
        if len(corners) % 3:
            raise InputError(f"expected three corners a triangle, found {len(corners)} in all")
        return corners.reshape(-1, 3)
    if len(corners) < 3:
        return np.zeros((0, 3), np.int64)
    if mode == _STRIP:  # every second triangle of a strip winds the other way
        faces = np.column_stack([corners[:-2], corners[1:-1], corners[2:]])
        faces[1::2] = faces[1::2, [1, 0, 2]]
    else:
        faces = np.column_stack([np.full(len(corners) - 2, corners[0]), corners[1:-1], corners[2:]])
    a, b, c = faces.T
    return faces[(a != b) & (b != c) & (c != a)]  # what joins two strips is no surface
